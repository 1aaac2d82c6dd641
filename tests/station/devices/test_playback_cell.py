"""A recording plays as a whole cell, marked as playback everywhere."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from calibrate.kinematics import MODELS, forward
from recordings.schema.messages import CameraModel, Image, RobotIdentity, SessionInfo, Stamps, View
from recordings.writer import RecordingWriter
from station.cell.config import PAPER_BOARD, CameraConfig, RobotConfig, StationConfig
from station.cli.serve import serve_command
from station.devices.playback import playback_cell
from tests.codes import raises

CONFIG = StationConfig(
    robot=RobotConfig(model="UR10", host="192.168.1.9", serial="R1"),
    camera=CameraConfig(driver="aravis", device="KJ1", trigger="hardware"),
    board=PAPER_BOARD,
    name="cell-3",
)


def record(path: Path, config: bytes | None, *, joints: bool = True) -> Path:
    info = SessionInfo(
        "s", "eye-in-hand", "real", PAPER_BOARD, CameraModel(32, 24), robot=RobotIdentity(model="UR10")
    )
    writer = RecordingWriter(path, info)
    for i in range(2):
        start = (0.1 * i, -1.5, -1.5, -1.6, 1.57, 0.0)
        writer.image(Image(np.full((24, 32), 50 + i, np.uint8), Stamps(10**9 + i), i + 1, i))
        matrix = tuple(tuple(float(x) for x in row) for row in forward(MODELS["UR10"], start))
        writer.view(View(i, f"pose {i}", i, matrix, joints_rad=start if joints else None))
    if config is not None:
        writer.attach("config.yaml", "application/yaml", config)
    return writer.finish()


async def test_it_plays_the_recorded_poses_and_can_reach_no_hardware(tmp_path: Path) -> None:
    cell = playback_cell(record(tmp_path / "s.mcap", msgspec.yaml.encode(CONFIG)))
    assert cell.source == "playback" and not cell.simulated
    assert cell.config.robot.host == "" and cell.config.camera.driver == "playback"
    assert cell.config.trigger is None and cell.trigger is None and cell.config.name == "playback"
    assert cell.plan is not None and len(cell.plan.poses) == 2
    assert (await cell.camera.open()).driver == "playback"
    assert (await cell.camera.capture()).pixels[0, 0] == 50, "the arm stands at the first pose"


def test_what_cannot_be_replayed_says_why(tmp_path: Path) -> None:
    with raises("no-config"):
        playback_cell(record(tmp_path / "imported.mcap", None))
    with raises("no-config"):
        playback_cell(record(tmp_path / "odd.mcap", b"robot: {arms: 3}"))
    with raises("no-joints"):
        playback_cell(record(tmp_path / "poses.mcap", msgspec.yaml.encode(CONFIG), joints=False))
    with raises("unreadable-recording"):
        playback_cell(tmp_path / "none.mcap")


def test_exactly_one_cell_is_served(tmp_path: Path) -> None:
    with raises("usage"):
        serve_command(simulate=True, replay=tmp_path)
    with raises("usage"):
        serve_command()
