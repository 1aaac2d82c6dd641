"""A whole session before the real driver and library: an arm jogged while paused."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import numpy as np
import pytest

from station.cell.config import ControlPath, RobotConfig
from station.cell.pose_plan import Plan, PlannedPose
from station.cell.status import StationState as S
from station.devices.ur import UrRobot
from station.protocol.verbs import Purpose
from station.simulation.launch import AdminClient, SimulatedController
from station.simulation.truth import write_truth
from tests.codes import raises
from tests.conftest import asked
from tests.patience import until
from tests.station.session_rig import TRUTH, Rig

pytestmark = pytest.mark.process
HOME = np.array(TRUTH.start_joints_rad)
PLAN = Plan(
    "UR10",
    "eye-in-hand",
    tuple(PlannedPose(f"p{n}", tuple((HOME + 0.02 * n).tolist())) for n in range(1, 5)),
)


@pytest.fixture
async def cell(
    controller: Callable[..., SimulatedController], control_path: ControlPath, tmp_path: Path
) -> AsyncIterator[tuple[Rig, AdminClient]]:
    """A session in `idle` with the plan loaded, and the controller's back door."""
    write_truth(TRUTH, tmp_path / "truth.json")
    running = await asyncio.to_thread(controller, "UR10", truth=tmp_path / "truth.json")
    admin = running.admin()
    robot = UrRobot(RobotConfig(model="UR10", host=running.host, control=control_path), tmp_path / "log")
    rig = Rig(tmp_path / "root", robot=robot)
    await rig.start()
    await rig.until(S.IDLE)
    rig.session.take_lease(1, "anna")
    rig.session.load_plan(1, PLAN)
    yield rig, admin
    await rig.session.close()
    admin.close()


def joints(admin: AdminClient) -> np.ndarray:
    return np.array(admin.ask("state")["joints_rad"])


async def test_07_an_arm_jogged_while_paused_is_not_driven(cell: tuple[Rig, AdminClient]) -> None:
    rig, admin = cell
    await rig.give_go()
    await rig.until(S.MOVING)
    rig.session.pause("anna")
    await rig.until(S.PAUSED)
    await until(lambda: rig.session._run is not None and rig.session._run.done())
    summary = await rig.session.prepare(1, Purpose.RESUME)
    state = joints(admin)
    admin.ask("hand_move", path=[(state + 0.1).tolist()])
    await until(lambda: np.abs(joints(admin) - state - 0.1).max() < 1e-3)
    uploads = asked(admin, "upload")
    with raises("arm-moved"):
        await rig.session.go(1, summary.token)
    await asyncio.sleep(0.3)
    assert asked(admin, "upload") == uploads and rig.state is S.PAUSED
    assert np.abs(joints(admin) - state - 0.1).max() < 1e-3
