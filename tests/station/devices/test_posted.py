"""An arm whose pose a program posts: right posts are its states, wrong ones are named and not taken."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import sys
import time
import tracemalloc
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
import pytest

from recordings.geometry import base_from_flange, pose_from_quaternion
from recordings.schema.messages import RobotState
from station.cell.config import RobotConfig, StillnessConfig
from station.cell.errors import RobotError
from station.cell.stillness import StillnessMonitor
from station.devices import posted
from station.devices.posted import PAUSE_S, PostedArm
from station.devices.posts import read_declaration, read_post
from tests.codes import raises
from tests.patience import PATIENCE_S, until
from tests.station.session_rig import memory_config

LIVE = {"source": "live"}
TURN = np.array([0.5, -0.1, 0.3, 0.8])
POSE = [0.4, -0.2, 0.3, *(TURN / np.linalg.norm(TURN)).tolist()]


class Poster:
    """A program that posts to an arm's socket."""

    all: ClassVar[list[Poster]] = []

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self.t = 100.0
        self.all.append(self)

    @classmethod
    async def at(cls, arm: PostedArm, declared: dict[str, Any] | None = LIVE) -> Poster:
        poster = cls(*await asyncio.open_unix_connection(arm.path))
        if declared is not None:
            poster.say(declared)
        return poster

    def say(self, what: dict[str, Any] | bytes) -> None:
        self.writer.write(what if isinstance(what, bytes) else json.dumps(what).encode() + b"\n")

    def post(self, pose: Any = POSE, step_s: float = 0.01, **more: Any) -> None:
        self.t += step_s
        self.say({"base_from_flange": pose, "t": self.t} | more)

    async def rest(self, count: int = 60) -> None:
        """Post the same pose for a while; its clock goes as this computer's."""
        ahead_s = self.t - time.monotonic()
        for _ in range(count):
            self.post(step_s=time.monotonic() + ahead_s - self.t + 1e-6)
            await asyncio.sleep(0.01)

    async def refused(self) -> str:
        """The code with which the station let go of it."""
        async with asyncio.timeout(60):
            code: str = json.loads(await self.reader.readline())["code"]
        return code


def config(tcp_port: int | None = None, **still: float) -> Any:
    robot = RobotConfig(
        driver="posted", model="arm of three words", arm_class="servo", serial="A1", tcp_port=tcp_port
    )
    limits = StillnessConfig(**still)
    return msgspec.structs.replace(memory_config(), robot=robot, stillness=limits)


@pytest.fixture
async def arm(tmp_path: Path) -> AsyncIterator[PostedArm]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    arm = PostedArm(config(port), "real", tmp_path / "control.sock")
    connecting = asyncio.create_task(arm.connect())
    await until(lambda: len(arm._servers) == 2)
    yield arm
    connecting.cancel()
    await arm.close()
    while Poster.all:
        Poster.all.pop().writer.close()
    await asyncio.sleep(0)


def trouble(arm: PostedArm) -> str:
    """Code of what keeps the arm from being captured; empty: nothing."""
    try:
        arm.check(arm.state())
    except RobotError as error:
        return error.code
    return ""


def now(arm: PostedArm, seen: Callable[[RobotState], object]) -> bool:
    """True when the arm has news of which `seen` holds; late ones are waited for on a busy computer."""
    with contextlib.suppress(RobotError):
        return bool(seen(arm.state()))
    return False


async def test_a_posted_arm_is_there_with_its_first_pose_and_its_states_carry_poses_exactly(
    arm: PostedArm,
) -> None:
    states: list[RobotState] = []
    arm.subscribe(states.append)
    assert trouble(arm) == "post-nobody"
    poster = await Poster.at(arm, LIVE | {"robot": "arm of three words"})
    exact = pose_from_quaternion(POSE[:3], POSE[3:])
    poster.post(joints_rad=[0.1] * 7)
    poster.post(exact.tolist())
    poster.post([*POSE[:3], *(-x for x in POSE[3:])])  # the same rotation
    await until(lambda: len(states) == 3)
    identity = await arm.connect()
    assert (identity.model, identity.arm_class) == ("arm of three words", "servo")
    for state in states:
        assert np.abs(base_from_flange(state.tcp_pose, arm.identity.tcp_offset) - exact).max() < 1e-14
    assert [len(state.joints_rad) for state in states] == [7, 0, 0]


async def test_rest_and_the_state_of_a_moment_are_found_without_joints(arm: PostedArm) -> None:
    still = StillnessMonitor(StillnessConfig())
    arm.subscribe(still.add)
    poster = await Poster.at(arm)
    await poster.rest()
    await until(lambda: still.at_rest)
    seen_ns = time.monotonic_ns()
    await poster.rest(10)
    await until(lambda: now(arm, lambda s: s.stamps.host_monotonic_ns > seen_ns + 50_000_000))
    clock = arm.clock()
    assert clock is not None and clock.bound_s < 0.1
    found = arm.at(seen_ns)
    assert found.tcp_pose[:3] == tuple(POSE[:3]) and abs(found.stamps.host_monotonic_ns - seen_ns) < 1
    poster.t = 5.0  # the program's clock begins anew: a rest from before counts no more
    poster.post()
    await until(lambda: now(arm, lambda s: s.stamps.controller_s < 10))
    assert not still.at_rest


async def test_poses_without_a_time_are_of_their_arrival_within_a_stated_bound(arm: PostedArm) -> None:
    poster = await Poster.at(arm, LIVE | {"late_s": 0.015})
    for _ in range(10):
        poster.say({"base_from_flange": POSE})
        await asyncio.sleep(0.02)
    await until(lambda: trouble(arm) == "")
    clock = arm.clock()
    assert clock is not None and clock.bound_s == 0.015 + PAUSE_S
    now_ns = time.monotonic_ns()
    poster.say({"base_from_flange": POSE, "joints_rad": [0.1] * 6})
    await until(lambda: now(arm, lambda s: s.stamps.host_monotonic_ns > now_ns))
    found = arm.at(now_ns)
    assert found.tcp_pose[:3] == tuple(POSE[:3]) and found.joints_rad == ()  # told after that moment alone


WRONG = {
    "millimetres": ({"base_from_flange": [400.0, -200.0, 300.0, *POSE[3:]]}, "post-too-far"),
    "a quaternion that is none": ({"base_from_flange": [*POSE[:3], 0.5, 0.1, 0.3, 0.8, ]}, "post-rotation"),
    "column by column": (
        {"base_from_flange": pose_from_quaternion(POSE[:3], POSE[3:]).T.tolist()}, "post-rotation",
    ),
    "degrees": ({"base_from_flange": POSE, "joints_rad": [90.0] * 6}, "post-degrees"),
    "three joints": ({"base_from_flange": POSE, "joints_rad": [0.1] * 3}, "post-unreadable"),
    "six numbers": ({"base_from_flange": POSE[:6]}, "post-unreadable"),
    "no JSON": (b"\x00\xff nonsense\n", "post-unreadable"),
    "half a line": (b'{"base_from_flange": [0.1,\n', "post-unreadable"),
    "not a number": (b'{"base_from_flange": [NaN,0,0,0,0,0,1]}\n', "post-unreadable"),
    "a jump": ({"base_from_flange": [0.4, -0.2, 0.45, *POSE[3:]]}, "post-jump"),
    "a turn in no time": ({"base_from_flange": [*POSE[:3], *POSE[4:], POSE[3]]}, "post-jump"),
    "nanoseconds since 1970": ({"base_from_flange": POSE, "t": 1.8e18}, "post-unreadable"),
    "milliseconds": ({"base_from_flange": POSE, "t": 100_000.0}, "post-clock"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
async def test_a_wrong_post_is_named_and_nothing_is_taken_until_right_ones_go_on(
    arm: PostedArm, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    monkeypatch.setattr(posted, "AFTER_WRONG_S", PATIENCE_S)
    poster = await Poster.at(arm)
    await poster.rest(5)
    await until(lambda: trouble(arm) == "")
    what, code = WRONG[case]
    poster.say(what if isinstance(what, bytes) else {"t": poster.t + 0.01} | what)
    await until(lambda: trouble(arm) == code)
    poster.post()
    await asyncio.sleep(0.02)
    assert trouble(arm) == code, "for as long as a person needs to see it"
    monkeypatch.setattr(posted, "AFTER_WRONG_S", 0.0)
    poster.t += 0.02 + 1e6 * (case == "milliseconds")
    async with asyncio.timeout(PATIENCE_S):
        while trouble(arm):
            poster.post()
            await asyncio.sleep(0.02)


async def test_a_wrong_post_costs_no_right_one_that_came_with_it(arm: PostedArm) -> None:
    poster = await Poster.at(arm)
    poster.post()
    poster.say(b"nonsense\n")
    poster.post()
    await until(lambda: len(arm._states) == 2)
    assert trouble(arm) == "post-unreadable"


async def test_a_program_is_told_which_of_its_lines_are_wrong_and_goes_on(arm: PostedArm) -> None:
    poster = await Poster.at(arm)
    poster.post()
    poster.say(b"nonsense\n")
    poster.post()
    poster.say({"base_from_flange": [400.0, -200.0, 300.0, *POSE[3:]], "t": poster.t + 0.01})
    poster.post([0.4, -0.2, 0.9, *POSE[3:]])
    async with asyncio.timeout(PATIENCE_S):
        told = [json.loads(await poster.reader.readline()) for _ in range(3)]
    assert sorted((one["line"], one["code"]) for one in told) == [
        (3, "post-unreadable"),
        (5, "post-too-far"),
        (6, "post-jump"),
    ]
    assert all(one["text"] for one in told)
    states: list[RobotState] = []
    arm.subscribe(states.append)
    poster.post([0.4, -0.2, 0.9, *POSE[3:]])
    await until(lambda: states and states[-1].tcp_pose[2] == 0.9)


async def test_a_program_that_falls_silent_or_is_killed_is_named(arm: PostedArm) -> None:
    poster = await Poster.at(arm)
    await poster.rest(5)
    for _ in range(10):
        poster.post(step_s=0.0)  # the time stands still
    await until(lambda: trouble(arm) == "post-silent")
    poster.say(b'{"base_from_fl')
    poster.writer.close()
    await until(lambda: trouble(arm) == "post-nobody")
    again = await Poster.at(arm)
    await again.rest(5)
    await until(lambda: trouble(arm) == "")


async def test_the_first_program_has_the_arm_until_it_ends(arm: PostedArm) -> None:
    first = await Poster.at(arm)
    await first.rest(3)
    second = await Poster.at(arm)
    second.post([0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0])
    assert await second.refused() == "post-refused"
    assert "has the arm" in arm.notice
    await first.rest(3)
    await until(lambda: now(arm, lambda s: s.tcp_pose[:3] == tuple(POSE[:3])))


@pytest.mark.parametrize("first", [b"", b"0" * 32 + b"\n", b"{}\n", b"x" * 10_000], ids=len)
async def test_a_program_by_tcp_gives_the_token_first_and_is_one_as_any_other(
    arm: PostedArm, first: bytes
) -> None:
    assert arm.token_file.stat().st_mode & 0o777 == 0o600

    async def by_tcp(token: bytes) -> Poster:
        poster = Poster(*await asyncio.open_connection("127.0.0.1", arm._tcp_port))
        poster.say(token)
        poster.say(LIVE)
        return poster

    assert await (await by_tcp(first)).refused() == "post-token"
    await (await by_tcp(arm.token_file.read_bytes())).rest(3)
    await until(lambda: trouble(arm) == "")
    assert await (await by_tcp(first)).refused() == "post-token", "and not that another has the arm"
    assert await (await by_tcp(arm.token_file.read_bytes())).refused() == "post-refused"
    await arm.close()
    assert not arm.token_file.exists()


async def test_programs_that_give_no_token_do_not_pile_up_nor_keep_others_out(
    arm: PostedArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(posted, "FIRST_LINE_S", PATIENCE_S)
    door = ("127.0.0.1", arm._tcp_port)
    strangers = [Poster(*await asyncio.open_connection(*door)) for _ in range(posted.STRANGERS)]
    poster = Poster(*await asyncio.open_connection(*door))
    with contextlib.suppress(OSError):  # reset
        await strangers[0].reader.read()  # the oldest made room
    poster.say(arm.token_file.read_bytes())
    poster.say(LIVE)
    await poster.rest(3)
    await until(lambda: trouble(arm) == "")
    arm.notice = ""
    strangers += [Poster(*await asyncio.open_connection(*door)) for _ in range(2 * posted.STRANGERS)]
    for oldest in strangers[: -posted.STRANGERS]:
        with contextlib.suppress(OSError):  # reset
            await oldest.reader.read()
    poster.post(step_s=0.1)
    await until(lambda: trouble(arm) == "")
    assert not arm.notice, "strangers say nothing on the screen where a program has the arm"


async def test_a_stranger_that_writes_slowly_is_let_go(
    arm: PostedArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(posted, "FIRST_LINE_S", 0.3)
    stranger = Poster(*await asyncio.open_connection("127.0.0.1", arm._tcp_port))

    async def until_let_go() -> None:
        while await stranger.reader.read(1000):
            pass

    async def write_slowly() -> None:
        while True:
            stranger.say(b"0")
            await asyncio.sleep(0.05)

    writing = asyncio.create_task(write_slowly())
    async with asyncio.timeout(PATIENCE_S):
        with contextlib.suppress(ConnectionError):  # reset: a byte was on its way when the station closed
            await until_let_go()
    writing.cancel()


async def test_a_port_that_another_program_has_is_named_at_every_attempt(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        arm = PostedArm(config(other.getsockname()[1]), "real", tmp_path / "control.sock")
        for _ in range(2):
            with raises("socket"):
                await arm.connect()


@pytest.mark.parametrize(
    ("declared", "code"),
    [
        ({"source": "simulated"}, "post-refused"),
        ({"source": "playback"}, "post-refused"),
        (LIVE | {"robot": "another"}, "post-refused"),
        ({"source": "real"}, "post-undeclared"),
        (LIVE | {"convention": "yaw-pitch"}, "post-undeclared"),
        ({"base_from_flange": POSE}, "post-undeclared"),
    ],
)
async def test_a_program_that_declares_another_source_or_arm_is_refused(
    arm: PostedArm, declared: dict[str, Any], code: str
) -> None:
    poster = await Poster.at(arm, declared)
    poster.post()
    assert await poster.refused() == code
    assert trouble(arm) == "post-nobody"


@pytest.mark.parametrize(
    "line",
    [
        b'{"source": "live", "robot": "\xe4"}',
        b"\xff\xfe{",
        b"[" * 60_000,
        b'{"source":"live","late_s":1e999}',
    ],
)
def test_a_first_line_that_is_no_utf_8_or_no_json_is_refused_by_its_code(line: bytes) -> None:
    """Latin-1, UTF-16, nested without end, a number that is none."""
    with raises("post-undeclared", RobotError):
        read_declaration(line)


@pytest.mark.parametrize("line", [b"x" * 65536, b"{}\n" * 20_000, b"\n" * 65536])
async def test_of_a_flood_little_is_read_and_nothing_kept(arm: PostedArm, line: bytes) -> None:
    poster = await Poster.at(arm)
    await poster.rest(3)
    tracemalloc.start()
    for _ in range(20):
        poster.writer.write(line)
        await poster.writer.drain()  # waits in the program: the station reads at its own pace
    await until(lambda: trouble(arm) != "")
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most_bytes < 1_000_000 < 20 * len(line)
    poster.writer.transport.abort()
    await until(lambda: trouble(arm) == "post-nobody")


async def test_a_thousand_poses_a_second_are_kept(arm: PostedArm) -> None:
    states: list[RobotState] = []
    arm.subscribe(states.append)
    poster = await Poster.at(arm)
    for _ in range(100):
        for _ in range(5):
            poster.post(step_s=0.001)
        await asyncio.sleep(0.005)
    await until(lambda: bool(states) and states[-1].stamps.controller_s >= poster.t - 0.0005)
    assert len(states) > 250 and trouble(arm) == ""


async def test_typed_numbers_count_for_a_while_only_as_the_arm_then_moves_on(arm: PostedArm) -> None:
    states: list[RobotState] = []
    arm.subscribe(states.append)
    words = ["post", "--typed", "kuka-abc", "--socket", str(arm.path.with_suffix(".sock"))]
    typing = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "station.cli", *words, stdin=asyncio.subprocess.PIPE
    )
    typing.stdin.write(b"1 2 3\nX 400.0, Y -200.0, Z 300.0, A 0, B 0, C 0\n")
    await until(lambda: states)
    assert states[0].tcp_pose == pytest.approx((0.4, -0.2, 0.3, 0.0, 0.0, 0.0))
    await until(lambda: trouble(arm) == "post-silent")
    typing.stdin.close()
    assert await typing.wait() == 0


@pytest.mark.parametrize("typed", [[], ["--typed", "kuka-abc", "--source", "playback"]], ids=len)
async def test_a_refused_program_is_told_so_although_it_has_nothing_more_to_say(
    arm: PostedArm, typed: list[str]
) -> None:
    words = ["post", *typed, "--socket", str(arm.path.with_suffix(".sock"))]
    posting = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "station.cli", *words, stdin=asyncio.subprocess.PIPE
    )
    if not typed:
        await posting.communicate(b'{"source": "live", "robot": "another arm"}\n')
    assert await posting.wait() == 1


async def test_a_piped_line_that_is_refused_is_told_with_its_number(arm: PostedArm) -> None:
    words = ["post", "--socket", str(arm.path.with_suffix(".sock"))]
    posting = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "station.cli",
        *words,
        stdin=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    right = json.dumps({"base_from_flange": POSE, "t": 1.0}).encode()
    _, said = await posting.communicate(b'{"source": "live"}\n' + right + b"\nnonsense\n")
    assert posting.returncode == 3
    assert b"line 3: " in said


def test_a_matrix_is_read_as_rows_and_as_its_numbers_row_by_row() -> None:
    rows = [[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, -0.4], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]]
    poses = []
    for written in (rows, [number for row in rows for number in row]):
        _, pose = read_post(json.dumps({"base_from_flange": written}).encode(), None)
        poses.append(pose)
    assert poses[0] == poses[1] == pytest.approx((0.3, -0.4, 0.5, 0.0, 0.0, np.pi / 2))
    by_columns = np.array(rows).T.ravel().tolist()
    with raises("post-rotation"):
        read_post(json.dumps({"base_from_flange": by_columns}).encode(), None)
