"""The drift check: nothing moves or is lost without an approval, and its own recording ends it."""

from __future__ import annotations

from unittest.mock import AsyncMock

import msgspec
import pytest

from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan, PlannedPose
from station.cell.status import MotionPreview, PoseStatus, SessionStatus, StationState, StationStatus
from station.operate.drift_check import recorded, start_drift_check
from station.protocol import verbs
from tests.station.operate.test_motion import Telling
from tests.tui.conftest import FakeLink

PREVIEW = MotionPreview("t", "drift check", "cd" * 32, 8, 1.0, 0.5, 0.2, 30.0, "")


def loaded(*attempts: int) -> StationStatus:
    poses = tuple(PoseStatus(i, f"p{i}", attempt=attempt) for i, attempt in enumerate(attempts))
    return StationStatus(session=SessionStatus(poses=poses))


@pytest.fixture
def link() -> FakeLink:
    """Of a cell with something installed."""
    link = FakeLink()
    link.answers["installed"] = verbs.InstalledVersion(1, "valid")
    link.answers["prepare"] = PREVIEW
    return link


@pytest.mark.parametrize(("attempts", "named"), [((), False), ((0, 0, 0), True), ((1, 0, 0), False)])
async def test_a_plan_that_was_never_run_is_named_before_it_is_replaced(
    link: FakeLink, attempts: tuple[int, ...], named: bool
) -> None:
    approves = AsyncMock(return_value=True)
    assert await start_drift_check(link, loaded(*attempts), approves)
    assert bool(approves.await_args.args[0].warnings) is named
    assert link.asked[-1] == verbs.Go("t", PREVIEW.approval_sha256)


@pytest.mark.parametrize("attempt", [0, 1])
@pytest.mark.parametrize("refused", ["", "prepare", "go"])
async def test_it_is_loaded_again_where_nothing_was_started(
    link: FakeLink, refused: str, attempt: int
) -> None:
    approves = AsyncMock(return_value=bool(refused))
    link.refuse[refused] = RefusedError()
    if not refused:
        assert not await start_drift_check(link, loaded(attempt), approves)
        assert "go" not in link.verbs
    else:
        with pytest.raises(RefusedError):
            await start_drift_check(link, loaded(attempt), approves)
    assert link.asked[-1] == verbs.LoadPlan()


async def test_a_plan_whose_hash_was_approved_before_is_captured_as_it_is(link: FakeLink) -> None:
    plan = Plan("UR10", "eye-in-hand", (PlannedPose("p1", (0.0,) * 6),))
    assert await start_drift_check(link, loaded(), AsyncMock(return_value=True), plan=plan)
    assert verbs.LoadPlan(plan) in link.asked and "make_plan" not in link.verbs


def during(name: str, state: StationState = StationState.MOVING) -> StationStatus:
    return StationStatus(state=state, session=SessionStatus(name=name, check=name == "check"))


def after(name: str, state: StationState = StationState.IDLE) -> StationStatus:
    """A finished check; the session of before is shown again."""
    check = SessionStatus(name=name, recording="r.mcap", check=True)
    return msgspec.structs.replace(during("old", state), checked=check)


async def test_its_finished_recording_ends_it_after_pauses_too() -> None:
    told = [after("the check before"), during("check"), during("check", StationState.PAUSED)]
    last, sealing = after("check"), after("check", StationState.SEALING)
    assert await recorded(Telling(*told, sealing, last), "the check before") == last.checked


async def test_another_session_ends_it_without_a_recording() -> None:
    assert await recorded(Telling(during("check"), during("new")), "") is None
    assert await recorded(Telling(after("before"), during("new"), ends=True), "before") is None


async def test_an_arm_that_a_person_moves_is_guided(link: FakeLink) -> None:
    status = loaded()
    by_hand = msgspec.structs.replace(status, robot=msgspec.structs.replace(status.robot, by_hand=True))
    assert await start_drift_check(link, by_hand, AsyncMock())
    assert link.asked == [verbs.GetInstalled(), verbs.Freedrive(True, check=True)]
