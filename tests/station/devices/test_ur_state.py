"""The state stream: every sample, in order, with the time it came; what is said when some are missing."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from recordings.schema.messages import RobotState
from station.cell.config import RobotConfig
from station.cell.errors import StationError
from station.devices.ur_link import UrLink
from station.devices.ur_state import StateReader
from station.simulation.launch import SimulatedController
from tests.patience import PATIENCE_S, wait_until

pytestmark = pytest.mark.process

Start = Callable[..., SimulatedController]


class Stream:
    def __init__(self, host: str) -> None:
        self.states: list[RobotState] = []
        self.ends: list[str] = []
        self.reader = StateReader(host, self.states.append, self.ends.append)
        self.reader.start()
        self.reader.started.result(PATIENCE_S)


@pytest.fixture
def stream() -> Iterator[Callable[[SimulatedController], Stream]]:
    streams: list[Stream] = []

    def follow(running: SimulatedController) -> Stream:
        streams.append(Stream(running.host))
        return streams[-1]

    yield follow
    for s in streams:
        s.reader.close()


@pytest.mark.parametrize(("model", "rate_hz"), [("UR10", 125.0), ("UR10e", 500.0)])
def test_every_sample_comes_once_in_order_with_the_time_of_the_controller(
    controller: Start, stream: Callable[..., Stream], model: str, rate_hz: float
) -> None:
    running = controller(model)
    s = stream(running)
    time.sleep(1.0)
    states = list(s.states)
    with running.admin() as admin:
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
    assert min(delays) > -1e-4 and sorted(delays)[len(delays) // 2] < 0.02
    gaps = [x.stamps.host_wall_ns - x.stamps.host_monotonic_ns for x in states]
    assert max(gaps) - min(gaps) < 5_000_000


def test_frozen_data_are_no_samples(controller: Start, stream: Callable[..., Stream]) -> None:
    running = controller("UR10")
    s = stream(running)
    with running.admin() as admin:
        admin.ask("freeze")
        wait_until(lambda: s.reader.stands_still)
        count = len(s.states)
        time.sleep(0.1)
        assert s.reader.stands_still and len(s.states) == count


@pytest.mark.parametrize(("how", "words"), [("fin", "the robot closed"), ("rst", "the robot reset")])
def test_the_end_of_a_link_is_told_at_once(
    controller: Start, stream: Callable[..., Stream], how: str, words: str
) -> None:
    running = controller("UR10")
    s = stream(running)
    with running.admin() as admin:
        admin.ask("drop", how=how)
    s.reader.join(PATIENCE_S)
    assert not s.reader.is_alive()
    assert words in s.ends[0] and s.reader.ended == s.ends[0]


def test_a_silent_link_is_given_up(controller: Start, stream: Callable[..., Stream]) -> None:
    running = controller("UR10")
    s = stream(running)
    with running.admin() as admin:
        admin.ask("stall")
    s.reader.join(PATIENCE_S)
    assert s.ends == ["no data from the robot for 2 s"]


def test_a_port_that_is_no_rtde_is_refused() -> None:
    async def main() -> str:
        async def babble(_: Any, writer: asyncio.StreamWriter) -> None:
            writer.write(b"\x00\x01HTTP/1.1 400 Bad Request")
            await writer.drain()
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
            gone.set()

        gone = asyncio.Event()
        server = await asyncio.start_server(babble, "127.91.7.3", 30004)
        reader = StateReader("127.91.7.3", lambda _: None, lambda _: None)
        reader.start()
        try:
            await asyncio.wrap_future(reader.started)
        except StationError as error:
            return str(error)
        finally:
            await asyncio.to_thread(reader.close)
            await gone.wait()
            server.close()
        return ""

    assert "not RTDE" in asyncio.run(main())


async def test_the_pose_at_a_moment(controller: Start, tmp_path: Path) -> None:
    running = await asyncio.to_thread(controller, "UR10e")
    link = UrLink(RobotConfig(model="UR10e", host=running.host))
    await link.connect()
    with running.admin() as admin:
        admin.ask("hand_move", path=[[1.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]], speed_rad_s=0.8)
        await asyncio.sleep(0.8)
        asked_ns = time.monotonic_ns() - 60_000_000
        found = link.at(asked_ns)
        truth = admin.ask("truth", at_monotonic_ns=asked_ns)
    fit = link.clock()
    assert fit is not None
    bound_rad = 0.8 * fit.bound_s + 1e-4
    assert abs(found.joints_rad[0] - truth["joints_rad"][0]) < bound_rad
    assert math.dist(found.tcp_pose[:3], [row[3] for row in truth["base_from_flange"][:3]]) < bound_rad * 1.5
    assert found.stamps.host_monotonic_ns == asked_ns
    for late_ns in (200_000_000, -11_000_000_000):
        with pytest.raises(StationError):
            link.at(time.monotonic_ns() + late_ns)
    await link.close()


def test_the_first_sample_is_delivered_before_anybody_is_told_of_it(controller: Start) -> None:
    """A link that was told first took a state that it had not been given for one that never came."""
    told: list[bool] = []
    reader = StateReader(controller("UR10e").host, lambda _: told.append(reader.started.done()), print)
    reader.start()
    reader.started.result(PATIENCE_S)
    reader.close()
    assert told[0] is False
