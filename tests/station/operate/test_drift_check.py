"""The drift check: nothing moves or is lost without an approval, and its own recording ends it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import msgspec
import pytest

from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan, PlannedPose
from station.cell.status import MotionPreview, PoseStatus, SessionStatus, StationState, StationStatus
from station.operate import drift_check
from station.operate.drift_check import recorded, start_drift_check
from station.protocol import verbs

PREVIEW = MotionPreview("t", "drift check", "cd" * 32, 8, 1.0, 0.5, 0.2, 30.0, "")
LOADED = Plan("UR10", "eye-in-hand", (PlannedPose("p1", (0.0,) * 6),) * 3)


class FakeLink:
    root = Path("root")
    camera = "main"

    def __init__(self, *told: StationStatus) -> None:
        self.asked: list[verbs.Verb[Any]] = []
        self.refuse: type[verbs.Verb[Any]] | None = None
        self._told = told

    async def call(self, verb: verbs.Verb[Any], *, timeout_s: float = 0.0) -> Any:
        self.asked.append(verb)
        if self.refuse is type(verb):
            raise RefusedError()
        answers = {
            verbs.GetPlan: verbs.LoadedPlan(LOADED),
            verbs.MakePlan: verbs.Done(),
            verbs.Prepare: PREVIEW,
        }
        return answers.get(type(verb), verbs.Done())

    async def statuses(self) -> AsyncIterator[StationStatus]:
        for status in self._told:
            yield status


def loaded(*attempts: int) -> StationStatus:
    poses = tuple(PoseStatus(i, f"p{i}", attempt=attempt) for i, attempt in enumerate(attempts))
    return StationStatus(session=SessionStatus(poses=poses))


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift_check, "installed_calibration", lambda root, camera: None)


@pytest.mark.parametrize(("attempts", "named"), [((), False), ((0, 0, 0), True), ((1, 0, 0), False)])
async def test_a_plan_that_was_never_run_is_named_before_it_is_replaced(
    attempts: tuple[int, ...], named: bool
) -> None:
    link, approves = FakeLink(), AsyncMock(return_value=True)
    assert await start_drift_check(link, loaded(*attempts), approves)
    assert bool(approves.await_args.args[0].warnings) is named
    assert link.asked[-1] == verbs.Go("t", PREVIEW.approval_sha256)


@pytest.mark.parametrize("attempt", [0, 1])
@pytest.mark.parametrize("refused", [None, verbs.Prepare, verbs.Go])
async def test_it_is_loaded_again_where_nothing_was_started(
    refused: type[verbs.Verb[Any]] | None, attempt: int
) -> None:
    link, approves = FakeLink(), AsyncMock(return_value=refused is not None)
    link.refuse = refused
    if refused is None:
        assert not await start_drift_check(link, loaded(attempt), approves)
        assert verbs.Go not in map(type, link.asked)
    else:
        with pytest.raises(RefusedError):
            await start_drift_check(link, loaded(attempt), approves)
    assert link.asked[-1] == verbs.LoadPlan(LOADED)


async def test_the_poses_of_an_earlier_drift_check_are_not_offered_as_a_capture() -> None:
    link = FakeLink()
    assert not await start_drift_check(link, during("check", "r.mcap"), AsyncMock(return_value=False))
    assert link.asked[-1] == verbs.LoadPlan(msgspec.structs.replace(LOADED, poses=()))


async def test_a_plan_whose_hash_was_approved_before_is_captured_as_it_is() -> None:
    link, plan = FakeLink(), msgspec.structs.replace(LOADED, note="for the night")
    assert await start_drift_check(link, loaded(), AsyncMock(return_value=True), plan=plan)
    assert verbs.LoadPlan(plan) in link.asked and verbs.MakePlan not in map(type, link.asked)


def during(name: str, recording: str = "", state: StationState = StationState.IDLE) -> StationStatus:
    check = name == "check"
    return StationStatus(state=state, session=SessionStatus(name=name, check=check, recording=recording))


async def test_its_finished_recording_ends_it_after_pauses_too() -> None:
    told = [during("old"), during("check"), during("check", state=StationState.PAUSED)]
    last = during("check", "r.mcap")
    sealing = during("check", "r.mcap", StationState.SEALING)
    assert await recorded(FakeLink(*told, sealing, last), "old") == last.session


async def test_another_session_ends_it_without_a_recording() -> None:
    assert await recorded(FakeLink(during("check"), during("new", "r.mcap")), "") is None
    assert await recorded(FakeLink(during("check", "r.mcap"), during("new")), "check") is None


async def test_an_arm_that_a_person_moves_is_guided() -> None:
    link, status = FakeLink(), loaded()
    by_hand = msgspec.structs.replace(status, robot=msgspec.structs.replace(status.robot, by_hand=True))
    assert await start_drift_check(link, by_hand, AsyncMock())
    assert link.asked == [verbs.Freedrive(True, check=True)]
