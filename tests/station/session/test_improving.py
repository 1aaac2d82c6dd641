"""The poses that are left, planned anew: offered to a person, changed by nothing but that person's go."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.geometry import inverse, transform_points
from calibrate.kinematics import MODELS, forward
from calibrate.projection import project
from recordings.reader import open_recording
from station.analysis.estimation import seen_before
from station.analysis.worker import BoardDetection, sight
from station.cell.errors import LimitError
from station.cell.limits import check_plan
from station.cell.plan import Plan, PlannedPose
from station.cell.scene import cell_geometry
from station.cell.status import StationState as S
from station.plan.planner import PlanOptions
from station.plan.predict import next_best
from station.protocol.verbs import Purpose, Skip
from station.session.queue import PoseQueue
from tests.codes import raises
from tests.station.quick_plan import POOL, quick_plan
from tests.station.session_rig import TRUTH, NewRig, Rig, WorkerInThisProcess, crash, memory_config, sealed

POSES, BEFORE = 12, 7


class WorkerThatSees(WorkerInThisProcess):
    """Finds the board where the true camera would show it."""

    def __init__(self, rig: Rig) -> None:
        super().__init__()
        self.rig, self.noise = rig, np.random.default_rng(5)

    async def call(
        self, function: Callable[..., Any], *args: Any, timeout_s: float = 60.0, **named: Any
    ) -> Any:
        if function is not sight:
            return await super().call(function, *args, timeout_s=timeout_s, **named)
        flange = forward(MODELS["UR10"], self.rig.arm.joints)
        board = inverse(flange @ np.array(TRUTH.camera_mount)) @ np.array(TRUTH.board_place)
        points = board_points(TRUTH.board)
        pixels = project(TRUTH.camera, transform_points(board, points)).pixels
        return BoardDetection(
            self.sees.status, np.arange(len(points)), pixels + self.noise.normal(0, 0.1, pixels.shape)
        )


@pytest.fixture(autouse=True)
def _few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """As few as the plan that is replaced was made from."""
    monkeypatch.setattr("station.analysis.improvement.PlanOptions", partial(PlanOptions, pool=POOL))


@pytest.fixture(scope="module")
def plan() -> Plan:
    return quick_plan(memory_config(), TRUTH, seed=3, count=POSES)


@pytest.fixture
async def half_way(new_rig: NewRig, plan: Plan, monkeypatch: pytest.MonkeyPatch) -> Rig:
    """Paused after some poses, by a clock on which each of them takes its time."""
    hurried = SimpleNamespace(**vars(time) | {"monotonic": lambda: 1000 * time.monotonic()})
    monkeypatch.setattr("station.session.recording.time", hurried)
    rig = await new_rig()
    rig.session.context.workers = WorkerThatSees(rig)  # type: ignore[assignment]
    rig.session.load_plan(1, plan)
    ended = rig.session.store.watch(lambda: _pause_after(rig, BEFORE))
    await rig.give_go()
    await rig.until(S.PAUSED)
    ended()
    return rig


def _pause_after(rig: Rig, poses: int) -> None:
    if rig.session.store.status.session.captured == poses:
        rig.session.context.requests.pause_by = "anna"


def queue_of(rig: Rig) -> PoseQueue:
    return rig.session.context.require_queue()


async def test_the_remaining_poses_are_planned_anew_only_by_a_go(half_way: Rig, plan: Plan) -> None:
    rig = half_way
    await rig.until_true(lambda: bool(rig.session.store.status.estimate.improve))
    before, moves = queue_of(rig).sha256, rig.arm.log.count("move")
    summary = await rig.session.prepare(1, Purpose.REPLAN)
    assert summary.poses == POSES - BEFORE
    assert any("expected error at the end" in line for line in summary.changes)
    assert queue_of(rig).sha256 == before != summary.plan_sha256
    old = await rig.session.prepare(1, Purpose.RESUME)
    assert old.plan_sha256 == before
    with raises("approval-used"):
        rig.session.go(1, summary.token)  # the later question made it void
    assert rig.arm.log.count("move") == moves

    summary = await rig.session.prepare(1, Purpose.REPLAN)
    rig.session.go(1, summary.token)
    assert queue_of(rig).sha256 == summary.plan_sha256
    await rig.until(S.IDLE)
    recording = sealed(rig)
    assert [view.index for view in recording.views()] == list(range(POSES))
    driven = msgspec.json.decode(recording.attachments()["plan-2.json"], type=Plan)
    assert driven.poses[:BEFORE] == plan.poses[:BEFORE]
    assert not {p.joints_rad for p in driven.poses[BEFORE:]} & {p.joints_rad for p in plan.poses}
    rest = msgspec.structs.replace(driven, poses=driven.poses[BEFORE:])
    assert check_plan(rest, plan.poses[BEFORE - 1].joints_rad, cell_geometry(memory_config())).problems == ()


async def test_a_crash_before_the_first_of_them_is_saved_finds_what_was_agreed_to(
    half_way: Rig, new_rig: NewRig
) -> None:
    half_way.arm.slow = True
    summary = await half_way.session.prepare(1, Purpose.REPLAN)
    half_way.session.go(1, summary.token)
    await half_way.until(S.MOVING)
    crash(half_way)
    again = await new_rig(with_plan=False)
    assert again.state is S.STOPPED
    assert queue_of(again).sha256 == summary.plan_sha256
    assert queue_of(again).done == BEFORE
    again.session.take_lease(1, "anna")
    again.session.acknowledge("anna")
    with raises("images-unread"):
        await again.session.prepare(1, Purpose.REPLAN)


class WorkerThatLooksBack(WorkerInThisProcess):
    """Finds in the pictures on the disk what it found in them when they were taken."""

    def __init__(self, rig: Rig) -> None:
        super().__init__()
        self.known = list(rig.session.context.seen.values())

    async def call(
        self, function: Callable[..., Any], *args: Any, timeout_s: float = 60.0, **named: Any
    ) -> Any:
        if function is not seen_before:
            return await super().call(function, *args, timeout_s=timeout_s, **named)
        assert len(open_recording(args[0]).views()) == BEFORE  # it is whole by then
        return self.known


async def test_after_a_crash_the_pictures_before_it_count_in_the_estimate_and_the_offers(
    half_way: Rig, new_rig: NewRig
) -> None:
    await half_way.until_true(lambda: half_way.session.store.status.estimate.views == BEFORE)
    known = half_way.session.store.status
    crash(half_way)
    again = await new_rig(with_plan=False)
    elapsed_s = again.session.store.status.session.elapsed_s
    assert elapsed_s > 0.5 * known.session.elapsed_s > 0, "the time before the crash is part of the session's"
    again.session.context.workers = WorkerThatLooksBack(half_way)  # type: ignore[assignment]
    again.session.take_lease(1, "anna")
    again.session.acknowledge("anna")
    summary = await again.session.prepare(1, Purpose.NEXT_POSE)
    assert any("expected error" in change for change in summary.changes)
    await again.until_true(lambda: again.session.store.status.estimate.views == BEFORE)
    assert again.session.store.status.estimate.translation_mm == known.estimate.translation_mm
    await again.give_go(Purpose.RESUME)
    await again.until(S.IDLE)
    assert again.session.store.status.session.elapsed_s > elapsed_s
    assert [view.index for view in sealed(again).views()] == list(range(POSES))


async def test_nothing_moves_by_poses_that_the_disk_did_not_take(
    half_way: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    moves = half_way.arm.log.count("move")
    summary = await half_way.session.prepare(1, Purpose.REPLAN)
    monkeypatch.setattr("station.session.recording.write_state", full)
    half_way.session.go(1, summary.token)
    await half_way.until_true(lambda: "No space left" in half_way.session.store.status.reason)
    assert half_way.state is S.PAUSED
    assert half_way.arm.log.count("move") == moves


async def test_it_is_void_when_the_poses_change_meanwhile(half_way: Rig) -> None:
    summary = await half_way.session.prepare(1, Purpose.REPLAN)
    await half_way.session.edit(Skip, 1, lambda queue: queue.skip(BEFORE + 1))
    with raises("approval-used"):
        half_way.session.go(1, summary.token)
    assert "p09" in [status.name for status in queue_of(half_way).statuses]


@pytest.mark.parametrize("purpose", ["improve", "best"])
async def test_too_early_is_told(rig: Rig, purpose: str) -> None:
    with raises("no-session"):
        await rig.session.prepare(1, purpose)


async def test_the_pose_that_helps_most_is_added_and_taken_by_its_own_go(half_way: Rig, plan: Plan) -> None:
    rig = half_way
    before, moves = queue_of(rig), rig.arm.log.count("move")
    summary = await rig.session.prepare(1, Purpose.NEXT_POSE)
    assert summary.poses == 1
    assert f"added as pose {POSES + 1}" in summary.changes[0] and "expected error" in summary.changes[1]
    assert queue_of(rig) is before  # until a person says yes
    elapsed_s = rig.session.store.status.session.elapsed_s
    rig.session.go(1, summary.token)
    await rig.until(S.PAUSED)
    assert rig.arm.log.count("move") == moves + 1
    added = queue_of(rig).status(POSES)
    assert (added.name, added.state) == (f"p{POSES + 1} more", "done")
    assert queue_of(rig).open == before.open
    assert rig.session.store.status.session.elapsed_s >= elapsed_s > 0  # of the session, not of this run
    driven = queue_of(rig).pose(POSES).joints_rad
    assert min(np.abs(np.subtract(driven, pose.joints_rad)).max() for pose in plan.poses) > 0.01
    await rig.give_go(Purpose.RESUME)
    await rig.until(S.IDLE)
    assert len(sealed(rig).views()) == POSES + 1


async def test_a_pose_that_helps_is_checked_like_any(half_way: Rig) -> None:
    """Whatever the search thought of it."""
    worker, before = half_way.session.context.workers, queue_of(half_way)
    folded = PlannedPose("p01", (0.0, -1.5, 3.0, 0.0, 0.0, 0.0), why="folded", predicted_sigma_m=1e-4)

    class WorkerThatFolds(WorkerThatSees):
        async def call(
            self, function: Callable[..., Any], *args: Any, timeout_s: float = 60.0, **named: Any
        ) -> Any:
            found = await worker.call(function, *args, timeout_s=timeout_s, **named)
            return replace(found, next_pose=folded) if function is next_best else found

    half_way.session.context.workers = WorkerThatFolds(half_way)  # type: ignore[assignment]
    with raises("plan", LimitError):
        await half_way.session.prepare(1, Purpose.NEXT_POSE)
    assert queue_of(half_way) is before and half_way.session.store.status.go is None


def test_poses_that_were_tried_keep_their_places_and_are_not_replaced(plan: Plan) -> None:
    queue = PoseQueue(plan)
    queue.start_attempt(0)
    queue.mark(0, "done")
    queue.start_attempt(3)
    queue.retake(3)
    queue.skip(5)
    anew = [msgspec.structs.replace(pose, why="anew") for pose in plan.poses[: len(queue.fresh)]]
    found = queue.with_fresh(anew)
    assert found.status(0).state == "done" and found.pose(0) == plan.poses[0]
    assert found.status(3).attempt == 1 and found.pose(3) == plan.poses[3]
    assert found.status(5).state == "skipped"
    assert found.open == (3, *queue.fresh)
    assert {found.pose(index).why for index in queue.fresh} == {"anew"}
    assert queue.pose(1) == plan.poses[1]
