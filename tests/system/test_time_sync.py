"""Robot pose and picture belong to the same moment, also while the arm moves.

The robot's pose at the estimated middle of the exposure against the joints that the arm truly had at the true
middle. Arm and camera have drifting clocks of their own.
"""

from __future__ import annotations

import asyncio
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibrate.geometry import difference
from calibrate.kinematics import MODELS, forward
from recordings.schema.messages import Image
from station.cell.config import RobotConfig
from station.devices.ur import UrRobot
from station.simulation.camera import RenderedCamera
from station.simulation.cells import make_cell
from station.simulation.launch import AdminClient, start_controller
from station.simulation.truth import CellTruth, write_truth

pytestmark = pytest.mark.process
SETTLE_S = 2.0
_JOG_RAD = (0.35, 0.12, -0.1, 0.1, 0.2, 0.3)
_JOG_SPEED_RAD_S = 0.25


@dataclass
class Sync:
    time_error_ms: NDArray[np.float64]
    """Estimated minus true middle of the exposure"""
    bound_ms: NDArray[np.float64]
    position_error_mm: NDArray[np.float64]
    speed_mm_s: NDArray[np.float64]
    """Speed of the flange at that moment"""


async def measure(pictures: int) -> Sync:
    truth = make_cell(seed=3)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "truth.json"
        write_truth(truth, file)
        controller = await asyncio.to_thread(start_controller, truth=file)
        robot = UrRobot(RobotConfig("UR10", controller.host), Path(folder))
        camera = RenderedCamera(truth, controller.host)
        jogging = asyncio.create_task(jog(controller.host, truth))
        try:
            await robot.connect()
            await camera.open()
            end_s = asyncio.get_running_loop().time() + SETTLE_S
            while asyncio.get_running_loop().time() < end_s:
                await camera.preview()
                await camera.capture()
            rows = [await one(robot, camera, controller.host, truth) for _ in range(pictures)]
        finally:
            jogging.cancel()
            await camera.close()
            await robot.close()
            await asyncio.to_thread(controller.stop)
    return Sync(*np.array(rows).T)


async def one(
    robot: UrRobot, camera: RenderedCamera, host: str, truth: CellTruth
) -> tuple[float, float, float, float]:
    picture = await camera.capture()
    assert picture.time is not None
    middle_ns, bound_s = picture.time.host_monotonic_ns, picture.time.bound_s
    state = robot.at(middle_ns)
    true_ns = true_middle_ns(picture, truth)
    true_joints = (await asyncio.to_thread(ask_truth, host, true_ns))["joints_rad"]
    model = MODELS[truth.robot_model]
    delta = difference(forward(model, state.joints_rad), forward(model, true_joints))
    step = np.asarray(state.joint_speeds_rad_s) * 1e-4
    moved = (
        forward(model, np.asarray(state.joints_rad) + step)[:3, 3] - forward(model, state.joints_rad)[:3, 3]
    )
    return (
        (middle_ns - true_ns) / 1e6,
        bound_s * 1e3,
        1e3 * float(np.linalg.norm(delta[:3])),
        1e3 * float(np.linalg.norm(moved)) / 1e-4,
    )


def true_middle_ns(picture: Image, truth: CellTruth) -> int:
    """By the truth of the camera's clock, which no estimate may look at."""
    rate = 1 + truth.camera_clock_drift_ppm * 1e-6
    start_ns = (picture.stamps.device_ns - truth.camera_clock_offset_ns) / rate
    return round(start_ns + picture.exposure_us * 500)


def ask_truth(host: str, at_ns: int) -> dict[str, list[float]]:
    with AdminClient(host) as admin:
        return admin.ask("truth", at_monotonic_ns=at_ns)


async def jog(host: str, truth: CellTruth) -> None:
    """To and fro until cancelled."""
    start = np.array(truth.start_joints_rad)
    with AdminClient(host) as admin:
        for turn in range(10_000):
            target = start + (np.array(_JOG_RAD) if turn % 2 == 0 else 0.0)
            await asyncio.to_thread(
                admin.ask, "hand_move", path=[target.tolist()], speed_rad_s=_JOG_SPEED_RAD_S
            )
            await asyncio.sleep(0.5 + float(np.max(np.abs(_JOG_RAD))) / _JOG_SPEED_RAD_S)


async def test_the_pose_at_mid_exposure_is_right_while_the_arm_moves() -> None:
    sync = await measure(pictures=12)
    assert np.max(sync.speed_mm_s) > 50, "it did move"
    assert np.mean(np.abs(sync.time_error_ms) <= sync.bound_ms) >= 0.93
    # What a wrong time by its bound would do at this speed, and the robot's own clock's share of 1 ms.
    allowed_mm = sync.speed_mm_s * (sync.bound_ms + 1.0) / 1000 + 0.02
    assert np.mean(sync.position_error_mm <= allowed_mm) >= 0.9
