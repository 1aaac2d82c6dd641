"""A recording plays as the camera and the robot that were there."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS, forward
from recordings.geometry import difference, pose_from_vector
from recordings.images import encode_png
from recordings.schema.messages import (
    CameraIdentity,
    Image,
    RobotIdentity,
    RobotState,
    Stamps,
    View,
)
from recordings.writer import RecordingWriter
from station.cell.config import PAPER_BOARD, CameraConfig, RobotConfig, StationConfig
from station.cell.errors import StaleStateError
from station.cli.serve import serve_command
from station.devices.playback import PlaybackCamera, PlaybackRobot, playback_cell
from tests.codes import raises
from tests.patience import until
from tests.recordings.small_recording import make_info

STARTS = [(0.1 * i, -1.5, -1.5, -1.6, 1.57, 0.2 * i) for i in range(3)]
TCP = (0.0, 0.0, 0.1, 0.0, 0.0, 0.3)


def image(number: int) -> np.ndarray:
    return np.full((24, 32), 40 + 10 * number, np.uint8)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return record(tmp_path / "session.mcap", joints=True)


def record(path: Path, *, joints: bool, cut: int | None = None, config: bytes | None = None) -> Path:
    """`cut`: this picture's file lacks its end."""
    info = make_info(
        name="session",
        robot=RobotIdentity(model="UR10", serial="R1", tcp_offset=TCP),
        camera_identity=CameraIdentity("Daheng Imaging", "MER-131-75GM", "KJ1", "rendered"),
    )
    writer = RecordingWriter(path, info)
    for i, start in enumerate(STARTS):
        stamps = Stamps(host_monotonic_ns=10**9 + i * 200_000_000, host_wall_ns=10**18, device_ns=5)
        encoded = encode_png(image(i))[:-20] if i == cut else None
        writer.image(Image(image(i), stamps, frame_id=i + 1, sequence=i), encoded)
        flange = forward(MODELS["UR10"], start)
        matrix = tuple(tuple(float(x) for x in row) for row in flange)
        writer.view(View(i, f"pose {i}", i, matrix, joints_rad=start if joints else None, stamps=stamps))
    if config is not None:
        writer.attach("config.yaml", "application/yaml", config)
    return writer.finish()


async def test_robot_and_camera_stand_where_the_recorded_ones_stood(recording: Path) -> None:
    robot = PlaybackRobot(recording)
    camera = PlaybackCamera(robot)
    await robot.connect()
    with raises("not-open"):
        await camera.capture()
    identity = await camera.open()
    assert (identity.model, identity.serial, identity.driver) == ("MER-131-75GM", "KJ1", "playback")
    await robot.start_control()
    plan = robot.plan()
    assert [p.joints_rad for p in plan.poses] == STARTS and plan.robot == "UR10"
    for number in (2, 0, 1):
        await robot.move(STARTS[number], 0.6, 1.0)
        state = robot.state()
        assert np.allclose(state.joints_rad, STARTS[number]) and not any(state.joint_speeds_rad_s)
        base_from_tcp = pose_from_vector(state.tcp_pose)
        expected = forward(MODELS["UR10"], STARTS[number]) @ pose_from_vector(TCP)
        assert np.abs(difference(base_from_tcp, expected)).max() < 1e-9
        assert np.array_equal((await camera.capture()).pixels, image(number))
    await robot.close()


async def test_a_recorded_picture_that_cannot_be_decoded_is_the_cameras_error(tmp_path: Path) -> None:
    robot = PlaybackRobot(record(tmp_path / "a.mcap", joints=True, cut=1))
    camera = PlaybackCamera(robot)
    await robot.connect()
    await camera.open()
    await robot.start_control()
    await robot.move(STARTS[1], 0.6, 1.0)
    with raises("bad-image"):
        await camera.capture()
    await robot.move(STARTS[2], 0.6, 1.0)
    assert np.array_equal((await camera.capture()).pixels, image(2))
    await robot.close()


async def test_the_played_robot_needs_a_go_and_known_joints(recording: Path) -> None:
    robot = PlaybackRobot(recording)
    with raises("control-not-started"):
        await robot.move(STARTS[1], 0.6, 1.0)
    await robot.start_control()
    with raises("not-recorded"):
        await robot.move([0.5] * 6, 0.6, 1.0)
    with pytest.raises(StaleStateError):
        robot.at(time.monotonic_ns() - 20 * 10**9)


async def test_states_are_published_and_stop_ends_a_move(recording: Path) -> None:
    robot = PlaybackRobot(recording)
    states: list[RobotState] = []
    robot.subscribe(states.append)
    await robot.connect()
    await robot.start_control()
    await until(lambda: len(states) > 3)
    moving = asyncio.ensure_future(robot.move(STARTS[2], 0.6, 1.0))
    await asyncio.sleep(0)
    await robot.stop("test")
    await moving
    await robot.close()
    assert not robot.control and robot.state().joints_rad == STARTS[0]


CONFIG = StationConfig(
    robot=RobotConfig(model="UR10", host="192.168.1.9", serial="R1"),
    camera=CameraConfig(driver="aravis", device="KJ1", trigger="hardware"),
    board=PAPER_BOARD,
    name="cell-3",
)


async def test_a_cell_plays_the_recorded_poses_and_can_reach_no_hardware(tmp_path: Path) -> None:
    cell = playback_cell(record(tmp_path / "s.mcap", joints=True, config=msgspec.yaml.encode(CONFIG)))
    assert cell.source == "playback"
    assert cell.config.robot.host == "" and cell.config.camera.driver == "playback"
    assert cell.config.trigger is None and cell.trigger is None and cell.config.name == "playback"
    assert cell.plan is not None and len(cell.plan.poses) == len(STARTS)
    assert (await cell.camera.open()).driver == "playback"
    assert np.array_equal((await cell.camera.capture()).pixels, image(0)), "the arm stands at the first pose"


def test_a_configuration_that_named_no_arm_plays_the_recorded_one(tmp_path: Path) -> None:
    """Until the default was `unknown`, a recording of a UR10 held a configuration without its model."""
    unnamed = msgspec.structs.replace(CONFIG, robot=RobotConfig(host="192.168.1.9", serial="R1"))
    content = msgspec.yaml.encode(unnamed)
    assert b"model" not in content
    cell = playback_cell(record(tmp_path / "s.mcap", joints=True, config=content))
    assert cell.config.robot.model == "UR10"


ZEROS = b"camera_guess: {translation_m: [0, 0, 0], rotation_xyzw: [0, 0, 0, 0]}"
"""A quaternion of zeros is no rotation, least of all the identity."""


@pytest.mark.parametrize(
    ("how", "code"),
    [
        (None, "unreadable-recording"),
        ({"joints": True}, "no-config"),
        ({"joints": True, "config": b"robot: {arms: 3}"}, "no-config"),
        (
            {
                "joints": True,
                "config": b"camera_guess: {translation_m: [0, 0, 0], rotation_xyzw: [0, 0, 0, 0]}",
            },
            "no-config",  # a quaternion of zeros is no rotation, least of all the identity
        ),
        ({"joints": False, "config": msgspec.yaml.encode(CONFIG)}, "no-joints"),
    ],
)
def test_what_cannot_be_played_as_a_cell_says_why(tmp_path: Path, how: Any, code: str) -> None:
    path = tmp_path / "a.mcap"
    if how is None:
        path.write_bytes(b"\x89MCAP0\r\n")
    else:
        record(path, **how)
    with raises(code):
        playback_cell(path)


def test_exactly_one_cell_is_served(tmp_path: Path) -> None:
    with raises("usage"):
        serve_command(simulate=True, replay=tmp_path)
    with raises("usage"):
        serve_command()
