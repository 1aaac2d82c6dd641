"""In freedrive views are taken by themselves: of what is new and at rest, and one key takes one back."""

from __future__ import annotations

import asyncio
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest

from recordings.info import recording_info
from station.analysis import hand_guide
from station.analysis.hand_guide import HandGuide
from station.analysis.pool import WorkerError
from station.cell.config import vector6
from station.cell.status import GuidanceStatus
from station.cell.status import StationState as S
from station.protocol.verbs import Skip
from station.session import capture
from tests.codes import raises
from tests.patience import PATIENCE_S, until
from tests.station.operate.guided_views import guided_joints
from tests.station.session.test_estimator import WorkerThatLooksBack, WorkerThatSees
from tests.station.session_rig import TRUTH, NewRig, Rig, crash, sealed


@pytest.fixture
async def guided(new_rig: NewRig) -> Rig:
    rig = await new_rig(with_plan=False, guides=True)
    rig.session.context.workers = WorkerThatSees(rig)
    await rig.until(S.IDLE)
    rig.session.take_lease(1, "anna")
    rig.arm.rest()
    await rig.session.switch_free_drive(1, True)
    return rig


def lead(rig: Rig, joints: Any) -> None:
    rig.arm.joints = vector6(joints)
    rig.arm.rest()


def captured(rig: Rig) -> int:
    return rig.session.store.status.session.captured


def new_here(rig: Rig) -> bool:
    return rig.session.freedrive.guide is not None and rig.session.freedrive.guide.way.new


async def test_views_are_taken_by_themselves_and_taken_back(guided: Rig) -> None:
    rig = guided
    stops = guided_joints(TRUTH)
    for count, joints in enumerate(stops, start=1):
        lead(rig, joints)
        await until(lambda count=count: captured(rig) == count and rig.state is S.FREE_DRIVE)
    store = rig.session.store
    await until(lambda: store.status.estimate.views == len(stops) and not new_here(rig))
    shown = store.status
    assert len(shown.guidance.outline) == 4 and not shown.guidance.cause
    assert shown.estimate.floor_mm < shown.guidance.after_mm < shown.estimate.predicted_error_mm
    assert shown.guidance.still == 1.0 and not shown.guidance.enough
    await rig.session.edit(1, Skip(len(stops) - 1))
    assert captured(rig) == len(stops) - 1
    with raises("pose-not-taken"):
        await rig.session.edit(1, Skip(len(stops) - 1))
    await until(lambda: new_here(rig))
    glimpses = rig.camera.glimpses
    await until(lambda: rig.camera.glimpses > glimpses + 5)
    assert captured(rig) == len(stops) - 1, "it was not wanted from there"
    lead(rig, stops[0])
    await until(lambda: not new_here(rig))
    lead(rig, stops[-1])
    await until(lambda: captured(rig) == len(stops) and rig.state is S.FREE_DRIVE)
    await rig.session.edit(1, Skip(0))
    await rig.session.finish(1)
    recording = sealed(rig)
    info, kept = recording_info(recording), [view.index for view in recording.views()]
    assert info.attempts - info.poses == info.taken_back == 2, "none was retaken"
    assert kept == [1, 2, 3, len(stops)], "the view that was taken back last is in the way of none"
    assert not [asked for asked in rig.arm.log if asked not in ("close",)], "the station moved nothing"


async def test_it_is_enough_when_views_and_precision_are(
    guided: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = guided.session.store
    await until(lambda: store.status.estimate.views == 1 and guided.state is S.FREE_DRIVE)
    for least, precise in ((1, True), (2, True), (1, True), (1, False)):
        monkeypatch.setattr("station.cell.status.FEWEST_BY_HAND", least)
        store.update(estimate=msgspec.structs.replace(store.status.estimate, enough=precise))
        enough = least == 1 and precise
        await until(lambda enough=enough: store.status.guidance.enough is enough)


async def test_a_defect_in_the_guidance_costs_one_look(guided: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    look, defects = HandGuide.look, [ZeroDivisionError("a defect")]

    async def broken(*given: Any) -> GuidanceStatus:
        if defects:
            raise defects.pop()
        return await look(*given)

    monkeypatch.setattr(HandGuide, "look", broken)
    await until(lambda: captured(guided) == 1)
    assert not defects and guided.told("internal")


@pytest.mark.parametrize("counts", [True, False])
async def test_views_before_a_crash_count_in_the_guidance_unless_taken_back(
    guided: Rig, new_rig: NewRig, counts: bool
) -> None:
    await until(lambda: captured(guided) == 1 and guided.state is S.FREE_DRIVE)
    if not counts:
        await guided.session.edit(1, Skip(0))
    crash(guided)
    again = await new_rig(with_plan=False, guides=True)
    again.session.context.workers = WorkerThatLooksBack(guided)
    again.session.take_lease(1, "anna")
    await again.session.acknowledge("anna")
    await again.session.switch_free_drive(1, True)
    assert list(again.session.context.seen) == [0] * counts
    assert captured(again) == counts


async def test_nothing_is_taken_of_what_moves(guided: Rig) -> None:
    rig = guided
    await until(lambda: captured(rig) == 1)
    rig.camera.jumps = 3  # the arm rests, the picture does not
    lead(rig, guided_joints(TRUTH)[1])
    await until(lambda: S.SETTLING in rig.states[-1:] or rig.camera.glimpses > 20)
    await until(lambda: rig.state is S.FREE_DRIVE)
    assert captured(rig) == 1 and rig.pose_states == ["done"] and not rig.told("not-settled")
    await rig.session.record(1)
    assert rig.pose_states == ["done", "failed"] and rig.told("not-settled"), "who asked is told"
    rig.camera.jumps = 0


async def test_what_could_not_be_checked_is_kept_only_for_who_asked(
    guided: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hand_guide, "GIVE_UP_S", PATIENCE_S)
    await until(lambda: captured(guided) == 1 and guided.state is S.FREE_DRIVE)
    late = Mock(side_effect=WorkerError("worker-late", function="sight"))
    monkeypatch.setattr(capture, "sight", late)
    lead(guided, guided_joints(TRUTH)[1])
    await until(lambda: guided.told("not-checked") and guided.state is S.FREE_DRIVE)
    assert guided.pose_states == ["done"]
    await guided.session.record(1)
    assert guided.pose_states == ["done", "done"]


async def test_what_failed_once_is_tried_again_without_a_nudge(
    guided: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hand_guide, "GIVE_UP_S", 0.05)
    await until(lambda: captured(guided) == 1 and guided.state is S.FREE_DRIVE)
    with monkeypatch.context() as now:
        now.setattr(capture, "sight", Mock(side_effect=WorkerError("worker-late", function="sight")))
        lead(guided, guided_joints(TRUTH)[1])
        await until(lambda: guided.told("not-checked"))
    await until(lambda: captured(guided) == 2)


async def test_an_arm_that_tells_no_pose_neither_rests_nor_moves(guided: Rig) -> None:
    rig, store = guided, guided.session.store
    await until(lambda: captured(rig) == 1 and rig.state is S.FREE_DRIVE)
    await rig.session.edit(1, Skip(0))
    await until(lambda: new_here(rig) and store.status.guidance.still == 1.0)
    rig.arm.late = True
    await until(lambda: store.status.guidance.still == 0.0 and store.status.guidance.moves)
    rig.arm.late = False
    await until(lambda: store.status.guidance.still == 1.0)
    glimpses = rig.camera.glimpses
    await until(lambda: rig.camera.glimpses > glimpses + 3)
    assert captured(rig) == 0, "it was taken back, and nothing moved since"


async def test_freedrive_that_ends_while_news_are_late_is_no_fault(guided: Rig) -> None:
    rig = guided
    await until(lambda: captured(rig) == 1 and rig.state is S.FREE_DRIVE)
    rig.arm.late = True
    asked = asyncio.create_task(rig.session.record(1))
    await until(lambda: rig.session.freedrive.taking)
    await rig.session.switch_free_drive(1, False)
    rig.arm.late = False
    await asyncio.wait({asked})
    assert asked.exception() is not None
    assert rig.state is S.PAUSED and captured(rig) == 1
    await until(lambda: rig.session.store.status.guidance == GuidanceStatus())
