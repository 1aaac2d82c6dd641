"""Robot pose and picture belong to the same moment, also while the arm moves.

The robot's pose at the estimated middle of the exposure against the joints that the arm truly had at the true
middle. Arm and camera have drifting clocks of their own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibrate.geometry import difference
from calibrate.kinematics import MODELS, forward
from station.cell.config import RobotConfig
from station.devices.ur import UrRobot
from station.simulation.camera import RenderedCamera
from station.simulation.cells import make_cell
from station.simulation.launch import AdminClient, SimulatedController
from station.simulation.truth import CellTruth, write_truth

pytestmark = pytest.mark.process
PICTURES = 12
_UNTIL_CLOCKS_ARE_KNOWN_S = 2.0
_JOG_RAD = np.array((0.35, 0.12, -0.1, 0.1, 0.2, 0.3))
_JOG_SPEED_RAD_S = 0.25


async def one(robot: UrRobot, camera: RenderedCamera, admin: AdminClient, truth: CellTruth) -> list[float]:
    """Error and bound of the time (s), error of the position (m), and the flange's speed (m/s)."""
    picture = await camera.capture()
    assert picture.time is not None
    middle_ns, model = picture.time.host_monotonic_ns, MODELS[truth.robot_model]
    state = robot.at(middle_ns)
    # By the truth of the camera's clock, which no estimate may look at.
    start_ns = picture.stamps.device_ns - truth.camera_clock_offset_ns
    true_ns = round(start_ns + picture.exposure_us * 500)
    told = await asyncio.to_thread(admin.ask, "truth", at_monotonic_ns=true_ns)
    flange, joints = forward(model, state.joints_rad), np.asarray(state.joints_rad)
    delta = difference(flange, forward(model, told["joints_rad"]))
    soon = forward(model, joints + 1e-4 * np.asarray(state.joint_speeds_rad_s))
    moved_m = [float(np.linalg.norm(way)) for way in (delta[:3], soon[:3, 3] - flange[:3, 3])]
    return [(middle_ns - true_ns) / 1e9, picture.time.bound_s, moved_m[0], moved_m[1] / 1e-4]


async def jog(host: str, truth: CellTruth) -> None:
    """To and fro until cancelled."""
    with AdminClient(host) as admin:
        for turn in range(10_000):
            target = np.array(truth.start_joints_rad) + (turn % 2 == 0) * _JOG_RAD
            path = [target.tolist()]
            await asyncio.to_thread(admin.ask, "hand_move", path=path, speed_rad_s=_JOG_SPEED_RAD_S)
            await asyncio.sleep(0.5 + float(_JOG_RAD.max()) / _JOG_SPEED_RAD_S)


async def test_the_pose_at_mid_exposure_is_right_while_the_arm_moves(
    controller: Callable[..., SimulatedController], tmp_path: Path
) -> None:
    truth = make_cell(seed=3)
    write_truth(truth, tmp_path / "truth.json")
    host = (await asyncio.to_thread(controller, truth=tmp_path / "truth.json")).host
    robot, camera = UrRobot(RobotConfig(model="UR10", host=host), tmp_path), RenderedCamera(truth, host)
    jogging = asyncio.create_task(jog(host, truth))
    try:
        await robot.connect()
        await camera.open()
        end_s = asyncio.get_running_loop().time() + _UNTIL_CLOCKS_ARE_KNOWN_S
        while asyncio.get_running_loop().time() < end_s:
            await camera.glimpse()
            await camera.capture()
        with AdminClient(host) as admin:
            rows = [await one(robot, camera, admin, truth) for _ in range(PICTURES)]
    finally:
        jogging.cancel()
        await camera.close()
        await robot.close()
    late_s, bound_s, off_m, speed_m_s = np.array(rows).T
    assert speed_m_s.max() > 0.05, "it did move"
    assert np.mean(np.abs(late_s) <= bound_s) >= 0.93
    # What a wrong time by its bound would do at this speed, and the robot's own clock's share of 1 ms.
    assert np.mean(off_m <= speed_m_s * (bound_s + 1e-3) + 2e-5) >= 0.9
