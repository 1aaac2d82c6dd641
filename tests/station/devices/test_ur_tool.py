"""TCP mix-ups: offset and pose must fit the arm's kinematics, and stay as they are."""

from __future__ import annotations

import asyncio
import random
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS, RobotModel, forward
from recordings.geometry import pose_from_vector, rotation_log
from recordings.schema.messages import RobotState, Vector6
from station.cell.config import RobotConfig
from station.cell.errors import RobotError
from station.devices.ur import UrRobot
from station.devices.ur.tool import PORT, Installation, PrimaryReader, TcpCheck, read_state
from station.simulation.controller.primary import state
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.state import Journal, Settings
from tests.codes import raises
from tests.patience import PATIENCE_S, until
from tests.recordings.small_recording import PLAYING

UR10 = MODELS["UR10"]
NO_TOOL: Vector6 = (0.0,) * 6
TOOL: Vector6 = (0.01, -0.02, 0.15, 0.1, 0.0, 0.5)
HERE: Vector6 = (0.3, -1.2, 1.4, -1.5, -1.4, 0.2)
THERE: Vector6 = (-0.8, -1.7, 1.9, -0.9, 1.2, 2.0)
FACTORY = UR10.calibrated(
    a_m=(0.0, 0.0008, -0.0006, 0.0, 0.0, 0.0), theta_rad=(0.0, 0.001, -0.002, 0.001, 0.0, 0.0)
)


def sample(arm: RobotModel, joints_rad: Vector6, tool: Vector6) -> RobotState:
    """Give what a controller with this arm reports."""
    T = forward(arm, joints_rad) @ pose_from_vector(tool)
    pose = tuple(np.concatenate([T[:3, 3], rotation_log(T[:3, :3])]).tolist())
    return msgspec.structs.replace(PLAYING, joints_rad=joints_rad, tcp_pose=pose)


def stated(arm: RobotModel, tool: Vector6) -> Installation:
    return Installation(tool, (arm.theta_rad, arm.a_m, arm.d_m, arm.alpha_rad))


@pytest.mark.parametrize(
    ("arm", "table", "told", "changes"),
    [
        (UR10, UR10, True, ((0, 0.001), (5, 0.003))),
        (FACTORY, UR10, True, ((0, 0.001),)),
        (UR10, UR10, False, ((0, 0.015), (5, 0.03))),
        (FACTORY, UR10, False, ((0, 0.015),)),
        (FACTORY, FACTORY, False, ((0, 0.001), (5, 0.003))),
    ],
    ids=["as published", "factory calibration", "published, untold: coarse", "untold: coarse", "configured"],
)
def test_a_tool_is_found_and_its_change_noticed(
    arm: RobotModel, table: RobotModel, told: bool, changes: tuple[tuple[int, float], ...]
) -> None:
    words = stated(arm, TOOL) if told else Installation()
    check = TcpCheck(table, table is FACTORY, sample(arm, HERE, TOOL), words)
    if told or arm is table:
        assert check.offset == pytest.approx(TOOL, abs=1e-9)
    check.check(sample(arm, THERE, TOOL), words)
    for number, by in changes:
        moved = [*TOOL]
        moved[number] += by
        with raises("tcp-changed"):
            check.check(sample(arm, THERE, tuple(moved)), words)


LONG: Vector6 = (0.0, 0.0, 1.05, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("arm", "tool", "words", "code"),
    [
        ("UR5", TOOL, stated(MODELS["UR5"], TOOL), "other-kinematics"),
        ("UR10e", TOOL, stated(MODELS["UR10e"], TOOL), "other-kinematics"),
        ("UR5", TOOL, Installation(TOOL), "tcp-mismatch"),
        ("UR10e", TOOL, Installation(TOOL), "tcp-mismatch"),
        ("UR10", TOOL, Installation(NO_TOOL), "tcp-mismatch"),
        ("UR10", LONG, stated(UR10, LONG), "tcp-too-far"),
    ],
)
def test_another_arm_or_tool_than_stated_is_noticed(
    arm: str, tool: Vector6, words: Installation, code: str
) -> None:
    with raises(code):
        TcpCheck(UR10, False, sample(MODELS[arm], HERE, tool), words)


def test_the_factory_calibration_is_told_where_it_explains_the_poses() -> None:
    own = FACTORY
    told = TcpCheck(UR10, False, sample(own, HERE, TOOL), stated(own, TOOL)).kinematics
    assert told is not None and (told.model, told.source) == ("UR10", "controller")
    assert told.a_m == own.a_m and told.theta_rad == own.theta_rad
    # Stated untruly: the poses follow another table than the one on the wire.
    far = UR10.calibrated(a_m=(0.0, 0.003, 0.0, 0.0, 0.0, 0.0))
    assert TcpCheck(UR10, False, sample(far, HERE, TOOL), stated(UR10, TOOL)).kinematics is None
    assert TcpCheck(UR10, False, sample(UR10, HERE, TOOL), Installation()).kinematics is None
    configured = TcpCheck(own, True, sample(own, HERE, TOOL), Installation()).kinematics
    assert configured is not None and configured.source == "configuration"


def test_in_motion_joints_and_pose_of_neighbouring_cycles_are_no_change_but_another_tool_is() -> None:
    check = TcpCheck(FACTORY, True, sample(FACTORY, HERE, TOOL), Installation())
    speeds: Vector6 = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    ahead: Vector6 = (HERE[0] + 0.008, *HERE[1:])
    late = msgspec.structs.replace(sample(FACTORY, HERE, TOOL), joints_rad=ahead, joint_speeds_rad_s=speeds)
    check.check(late, Installation())
    with raises("tcp-changed"):
        check.check(msgspec.structs.replace(late, joint_speeds_rad_s=NO_TOOL), Installation())
    moved = sample(FACTORY, HERE, (TOOL[0] + 0.08, *TOOL[1:]))
    with raises("tcp-changed"):
        check.check(msgspec.structs.replace(moved, joint_speeds_rad_s=speeds), Installation())


def test_an_arm_that_another_program_moves_at_connect_is_no_mix_up_and_keeps_its_calibration() -> None:
    speeds: Vector6 = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    ahead: Vector6 = (HERE[0] + 0.008, *HERE[1:])
    late = msgspec.structs.replace(sample(FACTORY, HERE, TOOL), joints_rad=ahead, joint_speeds_rad_s=speeds)
    with raises("tcp-moving"):
        TcpCheck(UR10, False, late, Installation())
    check = TcpCheck(UR10, False, late, stated(FACTORY, TOOL))
    assert check.kinematics is not None and check.kinematics.a_m == FACTORY.a_m
    check.check(sample(FACTORY, THERE, TOOL), stated(FACTORY, TOOL))
    with raises("tcp-changed"):
        check.check(sample(FACTORY, THERE, (TOOL[0] + 0.001, *TOOL[1:])), stated(FACTORY, TOOL))


def test_a_changed_statement_is_noticed_before_the_arm_shows_it() -> None:
    check = TcpCheck(UR10, False, sample(UR10, HERE, TOOL), stated(UR10, TOOL))
    with raises("tcp-changed"):
        check.check(sample(UR10, HERE, TOOL), stated(UR10, (*TOOL[:5], 0.5001)))


def test_a_statement_that_comes_after_connecting_must_be_what_was_derived_there() -> None:
    check = TcpCheck(UR10, False, sample(UR10, HERE, TOOL), Installation())
    check.check(sample(UR10, HERE, TOOL), stated(UR10, TOOL))
    nominal = TcpCheck(UR10, False, sample(FACTORY, HERE, TOOL), Installation())
    with raises("tcp-late"):  # derived with the published table: every pose would be millimetres off
        nominal.check(sample(FACTORY, HERE, TOOL), stated(FACTORY, TOOL))


@pytest.mark.parametrize("used", [None, "at", "start_control", "guided"])
async def test_it_is_taken_where_no_picture_and_no_motion_relies_on_the_derived_one(
    used: str | None, tmp_path: Path
) -> None:
    robot: Any = UrRobot(RobotConfig(model="UR10", host="127.0.0.1"), tmp_path)
    robot.link.tool._tcp = TcpCheck(UR10, False, sample(FACTORY, HERE, TOOL), Installation())
    robot.link.tool._primary = SimpleNamespace(installation=stated(FACTORY, TOOL), started="")
    robot.link.state = lambda: sample(FACTORY, HERE, TOOL)
    robot.link.dashboard = SimpleNamespace(alive=True)
    robot.link.guided = used == "guided"
    with suppress(RobotError):
        if used == "at":
            robot.link.at(0)
        if used == "start_control":
            await robot.start_control()
    await robot.link.supervise()
    assert (robot.link.identity.tcp_offset == TOOL) is (used is None)


async def test_a_controller_that_is_slow_to_state_its_tool_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("station.devices.ur.tool.SILENCE_S", PATIENCE_S)
    said, made = asyncio.Event(), SimulatedRobot(Settings(), Journal())
    made.tcp = TOOL

    async def talk(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await said.wait()
        writer.write(state(made, first=True))
        writer.close()

    host = loopback()
    async with await asyncio.start_server(talk, host, PORT):
        reader = PrimaryReader(host)
        waiting = asyncio.create_task(reader.first())
        await asyncio.wait({waiting}, timeout=1.2)
        assert not waiting.done()
        said.set()
        assert (await waiting).tcp_offset == TOOL
        await reader.close()


async def test_a_port_that_is_opened_late_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("station.devices.ur.tool.RETRY_S", 0.01)
    made = SimulatedRobot(Settings(), Journal())
    made.tcp = TOOL

    async def talk(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(state(made, first=True))
        writer.close()

    host = loopback()
    reader = PrimaryReader(host)
    assert (await reader.first()).tcp_offset is None
    async with await asyncio.start_server(talk, host, PORT):
        await until(lambda: reader.installation.tcp_offset == TOOL)
        await reader.close()


def loopback() -> str:
    return f"127.{random.randint(1, 254)}.{random.randint(0, 255)}.{random.randint(1, 254)}"


def state_of(made: SimulatedRobot) -> bytes:
    """The payload of its first robot state message."""
    return state(made, first=True)[5:]


def test_the_controllers_statements_are_understood() -> None:
    factory = (0.0, 1e-4, 0.0, 0.0, 0.0, 0.0)
    made = SimulatedRobot(Settings(model="UR10", factory_a_m=factory), Journal())
    made.tcp = TOOL
    said = read_state(state_of(made))
    table = made.table
    assert said.tcp_offset == TOOL
    assert said.dh == (table.theta_rad, table.a_m, table.d_m, table.alpha_rad)


@pytest.mark.parametrize("cut", [1, 4, 10, 20, 40, 60])
def test_a_damaged_message_is_refused(cut: int) -> None:
    message = state_of(SimulatedRobot(Settings(), Journal()))[:-cut]
    with raises("primary-interface"):
        read_state(message)
