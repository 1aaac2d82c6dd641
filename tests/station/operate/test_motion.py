"""What a command without a screen waits for before it begins."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import msgspec
import pytest

from recordings.schema.messages import CameraIdentity
from station.cell.errors import LimitError, RefusedError, StationError
from station.cell.pose_plan import Plan, PlannedPose
from station.cell.status import CameraStatus, MotionPreview, RobotStatus, StationState, StationStatus
from station.operate import motion
from station.protocol.verbs import PLANNED_ELSEWHERE, Done, GetPlan, LoadedPlan, MakePlan, Prepare, Purpose
from tests.recordings.small_recording import make_state

CAMERA = CameraStatus(CameraIdentity())
STANDING = RobotStatus(state=make_state(0))


class Telling:
    """A daemon's client as far as it is needed here."""

    def __init__(self, *told: StationStatus, ends: bool = False) -> None:
        self._told, self._ends = told, ends

    async def statuses(self) -> AsyncIterator[StationStatus]:
        for status in self._told:
            yield status
        if not self._ends:
            await asyncio.Event().wait()


def waited(*told: StationStatus) -> StationStatus:
    return asyncio.run(motion.wait_until_idle(Telling(*told)))


def idle(**fields: Any) -> StationStatus:
    return StationStatus(state=StationState.IDLE, camera=CAMERA, **fields)


@pytest.mark.parametrize("ready", [idle(robot=STANDING), idle(source="playback")])
def test_a_cell_is_ready_when_its_devices_are_there_and_joints_known_but_for_a_playback(
    ready: StationStatus,
) -> None:
    assert waited(StationStatus(), idle(), ready) is ready


@pytest.mark.parametrize(
    ("told", "missing"),
    [
        (StationStatus(), "no-robot"),
        (StationStatus(state=StationState.IDLE, robot=STANDING), "no-camera"),
        (idle(), "no-robot"),
    ],
)
def test_what_does_not_come_is_named(
    told: StationStatus, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motion, "CONNECT_WAIT_S", 0.01)
    with pytest.raises(RefusedError) as refused:
        waited(told)
    assert refused.value.code == missing


class Elsewhere:
    """A daemon whose arm stands elsewhere than its plan begins, until another plan is made."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.made = plan, False

    async def call(self, verb: object, **_: float) -> object:
        match verb:
            case GetPlan():
                return LoadedPlan(self.plan)
            case MakePlan():
                self.made = True
            case Prepare() if not self.made:
                raise LimitError(PLANNED_ELSEWHERE)
            case Prepare():
                return MotionPreview("t", "run plan", "ab" * 32, 1, 1.0, 0.1, 0.1, 10.0, "to pose 1")
        return Done()


@pytest.mark.parametrize("criterion", [None, "D", "arm", "all"])
def test_only_a_plan_of_default_poses_is_made_again(criterion: Any) -> None:
    async def yes(_: object) -> bool:
        return True

    def started(link: Elsewhere) -> bool:
        return asyncio.run(motion.prepared_motion(link, Prepare(Purpose.RUN), yes, plans_here=yes))

    plan = Plan("UR10", "eye-in-hand", (PlannedPose("p01", (0.0,) * 6),), criterion=criterion)
    link = Elsewhere(plan)
    with pytest.raises(StationError) as refused:
        started(link)
    assert refused.value.code == PLANNED_ELSEWHERE and not link.made
    own = Elsewhere(msgspec.structs.replace(plan, criterion="A"))
    assert started(own) and own.made
