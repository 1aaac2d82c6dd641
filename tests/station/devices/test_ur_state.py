"""The state stream: every sample, in order, with the time it came; what is said when some are missing."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from itertools import pairwise

import pytest

from recordings.schema.messages import RobotState
from station.cell.config import RobotConfig
from station.cell.errors import StationError
from station.devices.ur.link import UrLink
from station.devices.ur.stream import StateReader
from station.simulation.launch import AdminClient, SimulatedController
from tests.codes import raises
from tests.patience import until

pytestmark = pytest.mark.process

Start = Callable[..., SimulatedController]


class Stream:
    def __init__(self, running: SimulatedController) -> None:
        self.running = running
        self.states: list[RobotState] = []
        self.ends: list[str] = []
        self.reader = StateReader(running.host, self.states.append, self.ends.append)


Follow = Callable[..., Awaitable[Stream]]


@pytest.fixture
async def stream(controller: Start) -> AsyncIterator[Follow]:
    streams: list[Stream] = []

    async def follow(model: str = "UR10") -> Stream:
        streams.append(Stream(await asyncio.to_thread(controller, model)))
        await streams[-1].reader.open()
        return streams[-1]

    yield follow
    for s in streams:
        s.reader.close()


@pytest.mark.parametrize(("model", "rate_hz"), [("UR10", 125.0), ("UR10e", 500.0)])
async def test_every_sample_comes_once_in_order_with_the_time_of_the_controller(
    stream: Follow, model: str, rate_hz: float
) -> None:
    s = await stream(model)
    await asyncio.sleep(1.0)
    states = list(s.states)
    with s.running.admin() as admin:
        zero_ns = admin.ask("state")["controller_zero_monotonic_ns"]
    steps_s = [b.stamps.controller_s - a.stamps.controller_s for a, b in pairwise(states)]
    assert s.reader.rate_hz == rate_hz and len(states) > 0.8 * rate_hz
    assert max(abs(step_s - 1 / rate_hz) for step_s in steps_s) < 1e-9
    fit = s.reader.clock.fit()
    assert fit is not None and fit.bound_s < 0.005
    errors = sorted(
        abs(fit.to_host_ns(x.stamps.controller_s) - zero_ns - x.stamps.controller_s * 1e9) / 1e9
        for x in states
    )
    assert errors[int(0.99 * len(errors))] <= max(0.001, fit.bound_s)
    # Raw arrivals are never before the sample was made, nor after now; both clocks tell the same.
    delays = [(x.stamps.host_monotonic_ns - zero_ns) / 1e9 - x.stamps.controller_s for x in states]
    assert -1e-4 < min(delays) < 0.02
    gaps = [x.stamps.host_wall_ns - x.stamps.host_monotonic_ns for x in states]
    assert max(gaps) - min(gaps) < 5_000_000


async def test_frozen_data_are_no_samples(stream: Follow) -> None:
    s = await stream()
    with s.running.admin() as admin:
        admin.ask("freeze")
        await until(lambda: s.reader.stands_still)
        count = len(s.states)
        await asyncio.sleep(0.1)
        assert s.reader.stands_still and len(s.states) == count


@pytest.mark.parametrize(
    "fault", [{"cmd": "drop", "how": "fin"}, {"cmd": "drop", "how": "rst"}, {"cmd": "stall"}], ids=str
)
async def test_the_end_of_a_link_is_told_once(stream: Follow, fault: dict[str, str]) -> None:
    s = await stream()
    with s.running.admin() as admin:
        admin.ask(**fault)
    await until(lambda: s.ends)
    s.reader.read()
    assert s.ends == [s.reader.ended]


async def test_a_connection_that_is_still_being_opened_is_not_read() -> None:
    """The age of news is judged while a lost connection comes back, too."""
    ends: list[str] = []
    reader = StateReader("127.91.7.3", lambda _: None, ends.append)
    reader.read()
    assert reader.ended is None and not ends
    reader.close()


async def test_a_port_that_is_no_rtde_is_refused() -> None:
    async def babble(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"\x00\x01HTTP/1.1 400 Bad Request")
        writer.close()

    async with await asyncio.start_server(babble, "127.91.7.3", 30004):
        with raises("rtde"):
            await StateReader("127.91.7.3", lambda _: None, lambda _: None).open()


@pytest.fixture
async def link(controller: Start) -> AsyncIterator[UrLink]:
    running = await asyncio.to_thread(controller, "UR10e")
    made = UrLink(RobotConfig(model="UR10e", host=running.host))
    await made.connect()
    yield made
    await made.close()


async def test_the_pose_at_a_moment(link: UrLink) -> None:
    with AdminClient(link.config.host) as admin:
        admin.ask("hand_move", joints=[1.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0], speed_rad_s=0.8)
        await asyncio.sleep(0.8)
        asked_ns = time.monotonic_ns() - 60_000_000
        found = link.at(asked_ns)
        truth = admin.ask("truth", at_monotonic_ns=asked_ns)
    fit = link.clock()
    bound_rad = 0.8 * fit.bound_s + 1e-4
    assert abs(found.joints_rad[0] - truth["joints_rad"][0]) < bound_rad
    assert math.dist(found.tcp_pose[:3], [row[3] for row in truth["base_from_flange"][:3]]) < bound_rad * 1.5
    assert found.stamps.host_monotonic_ns == asked_ns
    for late_ns in (200_000_000, -11_000_000_000):
        with pytest.raises(StationError):
            link.at(time.monotonic_ns() + late_ns)


@pytest.mark.parametrize("moving", [True, False])
async def test_states_that_this_computer_is_late_to_read_are_not_late(link: UrLink, moving: bool) -> None:
    """One is worked on for longer than an arm in motion may be without news; the next ones come meanwhile."""
    held = iter([0.4])
    link.subscribe(lambda _: time.sleep(next(held, 0.0)))
    link.guided = moving
    for _ in range(120):
        assert link.overdue() is None
        await asyncio.sleep(0.005)
    assert next(held, None) is None
