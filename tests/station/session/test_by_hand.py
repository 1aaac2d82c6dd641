"""A cell whose arm a person moves: the station reads its pose, records views, and sends it nothing."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import pytest

from recordings.schema.messages import RobotState
from station.cell.errors import StationError
from station.cell.pose_plan import Plan
from station.cell.status import StationState
from station.protocol import verbs
from station.protocol.verbs import Verb
from tests.codes import raises
from tests.patience import until
from tests.station.session_rig import ArmInMemory, Rig, sealed

MOVES: list[type[Verb[object]]] = [verbs.LoadPlan, verbs.MakePlan, verbs.Prepare, verbs.Go, verbs.Retake]


class ReadArm(ArmInMemory):
    """An arm that tells its pose and, perhaps, its joints."""

    told: tuple[float, ...] = ()

    def _state(self) -> RobotState:
        state = super()._state()
        return msgspec.structs.replace(
            state, joints_rad=self.told, joint_speeds_rad_s=(), target_joints_rad=()
        )


@pytest.fixture
async def rig(tmp_path: Path) -> AsyncIterator[Rig]:
    rig = Rig(tmp_path / "root", robot=(arm := ReadArm()), by_hand=True)
    rig.arm = arm
    await rig.start()
    await rig.until(StationState.IDLE)
    rig.session.take_lease(1, "anna")
    yield rig
    await rig.session.close()


async def test_every_motion_is_refused_and_stop_sends_nothing(rig: Rig, small_plan: Plan) -> None:
    for verb in MOVES:
        with raises("moved-by-hand"):
            rig.session.admit(verb, 1, "anna")
    await rig.session.stop("anna")
    assert rig.state is StationState.STOPPED
    assert "stop" not in rig.arm.log


@pytest.mark.parametrize("told", [(), (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)])
async def test_views_by_hand_carry_the_told_pose_and_joints(rig: Rig, told: tuple[float, ...]) -> None:
    rig.arm.told = told
    await rig.session.switch_free_drive(1, True, check=bool(told))
    for turn in (0.0, 0.2):
        rig.arm.joints = (*rig.arm.joints[:5], rig.arm.joints[5] + turn)
        rig.arm.rest()
        await rig.session.record(1)
    await rig.session.switch_free_drive(1, False)
    with raises("session-open"):
        await rig.session.switch_free_drive(1, True, check=True)
    await rig.session.finish(1)
    recording = sealed(rig)
    assert rig.session.store.status.finished.check is bool(told)
    assert not rig.session.store.status.session.check
    assert [view.joints_rad for view in recording.views()] == [told or None] * 2
    assert {state.joints_rad for state in recording.robot_states()} == {told}
    assert recording.robot_samples().joints_rad.shape[1] == len(told)
    assert rig.arm.log == [] and rig.arm.beats == 0


async def test_a_pose_that_cannot_be_is_asked_about_with_its_view(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def odd(*of: object) -> StationError:
        return StationError("odd-view", others=5, x=0.0, y=0.0, z=90.0, turn=0.1)

    monkeypatch.setattr("station.session.estimator.odd_view", odd)
    await rig.session.switch_free_drive(1, True)
    await rig.session.record(1)
    await until(lambda: rig.told("odd-view"))
    assert rig.told("odd-view")[0].pose_index == 0
