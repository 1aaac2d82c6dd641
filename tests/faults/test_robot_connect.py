"""Faults at connect, at a go and between moves: nothing hangs, every refusal has a remedy."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from recordings.errors import ErrorData
from station.cell.config import RobotConfig
from station.cell.errors import RobotError, StaleStateError
from station.devices.rtde import RobotMode
from station.devices.ur import UrRobot
from station.simulation.launch import SimulatedController, start_controller
from tests.codes import raises
from tests.conftest import check_allow_list
from tests.faults.conftest import MakeCell
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.process

OTHERS = ["input_int_register_0", "input_int_register_24"]
"""Registers that another client owns: the first of each control path."""


@pytest.fixture(scope="module")
def arm() -> Iterator[SimulatedController]:
    """One for all tests that only connect."""
    with start_controller() as running:
        yield running
        check_allow_list(running.host)


def robot_at(host: str, folder: Path, model: str = "UR10", **config: Any) -> UrRobot:
    return UrRobot(RobotConfig(model=model, host=host, **config), folder / "log")


async def test_a_class_that_the_cell_file_tells_is_of_the_arms_identity(
    arm: SimulatedController, tmp_path: Path
) -> None:
    robot = robot_at(arm.host, tmp_path, arm_class="industrial-six")
    identity = await robot.link.connect()
    await robot.link.close()
    assert (identity.model, identity.arm_class) == ("UR10", "industrial-six")


def complaint(robot: UrRobot) -> ErrorData | None:
    try:
        robot.link.check(robot.link.state())
    except RobotError as error:
        return error.data
    return None


never_driven = pytest.mark.parametrize("control_path", ["script"])
"""Control is not started: there are no two ways of it."""


async def test_nobody_is_there(tmp_path: Path) -> None:
    with raises("dashboard"):
        await robot_at("127.255.3.9", tmp_path).link.connect()


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ({"cmd": "mute", "ports": ["dashboard"]}, "dashboard"),
        ({"cmd": "mute", "ports": ["rtde"]}, "rtde"),
        ({"cmd": "stall"}, "rtde"),
        ({"cmd": "black_hole"}, "dashboard"),
        ({"cmd": "black_hole", "ports": ["script"]}, "port-closed"),
        ({"cmd": "mute", "ports": ["script30002"]}, "port-silent"),
        ({"cmd": "black_hole", "ports": ["rtde"]}, "rtde"),
    ],
)
async def test_a_silent_controller_does_not_hang_the_station(
    arm: SimulatedController, tmp_path: Path, fault: dict[str, Any], code: str
) -> None:
    with arm.admin() as admin:
        admin.ask(**fault)
        robot = robot_at(arm.host, tmp_path)
        with raises(code):
            async with asyncio.timeout(PATIENCE_S):
                await robot.link.connect()
        admin.ask(**fault, on=False)
        await robot.link.connect()  # nothing is left over from the failure
        await robot.link.close()


async def test_no_tool_is_taken_from_a_controller_that_is_still_starting(
    arm: SimulatedController, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = robot_at(arm.host, tmp_path)
    with arm.admin() as admin, monkeypatch.context() as patch:
        admin.ask("power_off")  # in place of booting, which the simulator does not show
        patch.setattr("station.devices.ur.link.STARTING", (RobotMode.POWER_OFF,))
        with raises("not-powered"):
            await robot.link.connect()
    await robot.link.connect()
    await robot.link.close()


async def test_one_owner(arm: SimulatedController, tmp_path: Path) -> None:
    first, second = robot_at(arm.host, tmp_path), robot_at(arm.host, tmp_path)
    await first.link.connect()
    with raises("robot-owned"):
        await second.link.connect()
    await first.link.close()
    await second.link.connect()
    await second.link.close()


@never_driven
async def test_connecting_is_read_only(cell: MakeCell) -> None:
    c = await cell(control=False)
    await c.ask("foreign", name="palletising.urp")
    await c.until(lambda state: state["runtime_state"] == "PLAYING")
    await asyncio.sleep(0.5)
    assert (await c.ask("state"))["program"] == "palletising.urp"
    assert await c.asked("upload") == 0
    assert (await c.ask("state"))["claims"] == []


@pytest.mark.parametrize(
    ("model", "fault", "code"),
    [
        ("UR10", {"cmd": "foreign"}, "foreign-program"),
        ("UR10", {"cmd": "power_off"}, "not-powered"),
        ("UR10e", {"cmd": "remote", "on": False}, "local-control"),
        ("UR10", {"cmd": "pstop"}, "protective-stop"),
        ("UR10", {"cmd": "in_use", "inputs": OTHERS}, "registers-in-use"),
        ("UR10", {"cmd": "mute", "ports": ["script30002"]}, "port-silent"),
    ],
)
async def test_a_go_is_refused(cell: MakeCell, model: str, fault: dict[str, Any], code: str) -> None:
    c = await cell(model, control=False)
    await c.ask(**fault)
    if fault["cmd"] == "foreign":
        await c.until(lambda state: state["runtime_state"] == "PLAYING")
    await c.told()
    with raises(code):
        await c.robot.start_control()
    assert await c.asked("upload") == 0
    assert not c.robot.control


async def test_a_robot_switched_to_remote_after_connecting_can_be_driven(cell: MakeCell) -> None:
    c = await cell("UR10e", control=False, options=("--local",))
    assert c.robot.remote is False
    await c.ask("remote", on=True)
    await c.begin()
    assert c.robot.control


@never_driven
async def test_a_stop_that_a_connection_from_local_control_refuses_is_given_on_a_new_one(
    cell: MakeCell,
) -> None:
    c = await cell("UR10e", control=False, options=("--local",))
    await c.ask("remote", on=True)
    await c.ask("foreign", name="palletising.urp")
    await c.until(lambda state: state["runtime_state"] == "PLAYING")
    await c.robot.stop("F12")
    await c.until(lambda state: state["runtime_state"] == "STOPPED")


async def test_remote_control_lost_between_moves_ends_control(cell: MakeCell) -> None:
    c = await cell("UR10e")
    await c.ask("remote", on=False)
    await until(lambda: not c.robot.control)
    await asyncio.sleep(0.3)
    with raises("local-control"):
        await c.robot.start_control()


@never_driven
@pytest.mark.parametrize("fault", [{"cmd": "freeze"}, {"cmd": "stall"}])
async def test_old_news_is_not_taken_for_new(cell: MakeCell, fault: dict[str, Any]) -> None:
    c = await cell(control=False)
    await c.ask(**fault)
    await asyncio.sleep(0.15)
    with pytest.raises(StaleStateError):
        c.robot.link.state()
    await c.ask(**fault, on=False)
    await until(lambda: c.robot.link.states.age_s() < 0.05)
    c.robot.link.state()


async def test_the_link_comes_back_by_itself_but_control_does_not(cell: MakeCell) -> None:
    c = await cell()
    await c.ask("drop")
    await until(lambda: not c.robot.control)
    await until(lambda: c.robot.link.states.age_s() < 0.05)
    await c.stays_at_rest()
    await c.begin()
    await c.arrives(c.near())


CHANGES: dict[str, tuple[Any, Any]] = {
    "tcp-changed": ({"cmd": "tcp", "pose": [0.0, 0.0, 0.002, 0.0, 0.0, 0.0]}, {"pose": [0.0] * 6}),
    "payload-changed": (
        {"cmd": "payload", "kg": 1.5, "cog_m": [0.0, 0.0, 0.05]},
        {"kg": 0.0, "cog_m": [0.0, 0.0, 0.0]},
    ),
}


@pytest.mark.parametrize("code", CHANGES)
async def test_tcp_or_payload_changed_on_the_pendant(cell: MakeCell, code: str) -> None:
    c, (change, back) = await cell(), CHANGES[code]
    c.robot.link.check(c.robot.link.state())
    await c.ask(**change)
    await until(lambda: (told := complaint(c.robot)) is not None and told.code == code)
    told = complaint(c.robot)
    assert told is not None and told.values.get("shift_m", 0.002) == pytest.approx(0.002, abs=1e-4)
    with raises(code):
        await c.robot.move(c.near(), 0.5, 1.0)
    await c.stays_at_rest()
    await c.ask(**(change | back))
    await until(lambda: not complaint(c.robot))


async def test_a_tool_on_the_pendant_is_reported_and_not_mixed_in(cell: MakeCell) -> None:
    c = await cell(control=False)
    await c.robot.link.close()
    await c.ask("tcp", pose=[0.01, -0.02, 0.15, 0.0, 0.0, 0.5])
    await asyncio.sleep(0.1)
    identity = await c.robot.link.connect()
    assert identity.tcp_offset == pytest.approx((0.01, -0.02, 0.15, 0.0, 0.0, 0.5), abs=1e-6)
    await c.begin()  # reads the offset from the controller and compares


async def test_an_impossible_goal_is_never_sent(cell: MakeCell) -> None:
    c = await cell()
    with raises("bad-goal"):
        await c.robot.move([0.0, -1.5, 1.5, -1.5, float("nan"), 0.0], 0.5, 1.0)
    assert await c.asked("move") == 0
    assert c.robot.control  # a refused number is no fault


async def test_safety_stop_between_moves_ends_control(cell: MakeCell) -> None:
    c = await cell()
    await c.ask("estop")
    await until(lambda: not c.robot.control)
    with raises("emergency-stop"):
        c.robot.link.check(c.robot.link.state())


async def test_a_daemon_that_died_leaves_no_lock(arm: SimulatedController, tmp_path: Path) -> None:
    program = (
        "import os, sys; from station.devices.robot_lock import RobotLock\n"
        "if os.getuid() == 0: os.setgid(65534); os.setuid(65534)  # another user's, where that can be tried\n"
        "lock = RobotLock(sys.argv[1]); print('held', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", program, arm.host],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    with holder:
        assert holder.stdout.readline() == b"held\n"
        robot = robot_at(arm.host, tmp_path)
        with pytest.raises(RobotError, match=f"pid {holder.pid}"):
            await robot.link.connect()
        holder.kill()
        holder.wait()
        await robot.link.connect()
        await robot.link.close()
