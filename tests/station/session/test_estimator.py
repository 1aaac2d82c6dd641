"""The running estimate over a session, a restart in between."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS, forward
from calibrate.boards.model import board_points
from calibrate.views.corners import Corners
from recordings.reader import open_recording
from station.analysis.estimation import seen_before
from station.analysis.worker import sight
from station.cell.pose_plan import Plan
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose, Retake
from tests.durability import full
from tests.patience import until
from tests.station.quick_plan import quick_plan
from tests.station.session_rig import TRUTH, NewRig, Rig, WorkerInThisProcess, crash, memory_config, sealed
from tests.station.true_camera import board_seen, corners_seen

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
        pixels = corners_seen(TRUTH, board_seen(TRUTH, flange), self.noise)
        scale = args[0].shape[1] / TRUTH.camera.width  # glimpses are smaller
        seen = np.sort(
            self.noise.permutation(len(pixels))[int(scale < 1) :]
        )  # each glimpse lacks another corner
        corners = Corners(board_points(TRUTH.board), pixels).part(seen).scaled(scale)
        return replace(self.sees, detection=replace(self.sees.detection, corners=corners))


@pytest.fixture(scope="module")
def plan() -> Plan:
    return quick_plan(memory_config(), TRUTH, seed=3, count=POSES)


@pytest.fixture
async def half_way(new_rig: NewRig, plan: Plan, monkeypatch: pytest.MonkeyPatch) -> Rig:
    """Paused after some poses, by a clock on which each of them takes its time."""
    hurried = SimpleNamespace(**vars(time) | {"monotonic": lambda: 1000 * time.monotonic()})
    monkeypatch.setattr("station.session.recording.time", hurried)
    rig = await new_rig()
    rig.session.context.workers = WorkerThatSees(rig)
    rig.session.load_plan(1, plan)
    rig.session.store.watch(lambda: _pause_after(rig, BEFORE))
    await rig.go_until(S.PAUSED)
    return rig


def _pause_after(rig: Rig, poses: int) -> None:
    if rig.session.store.status.session.captured == poses and S.PAUSED not in rig.states:
        rig.session.context.requests.pause_by = "anna"


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
        assert len(open_recording(args[0]).views()) == len(self.known)  # it is whole by then
        return self.known


async def test_after_a_crash_the_pictures_before_it_count_in_the_estimate(
    half_way: Rig, new_rig: NewRig
) -> None:
    await until(lambda: half_way.session.store.status.estimate.views == BEFORE)
    known = half_way.session.store.status
    estimate = known.estimate
    assert 0.0 < estimate.floor_mm < estimate.with_more_views_mm < estimate.predicted_error_mm
    assert not estimate.enough, "solving asks for more views than these"
    planned = half_way.session.context.queue.plan
    assert known.session.floor_mm == pytest.approx(1000 * planned.floor_m, abs=1e-4)
    crash(half_way)
    again = await new_rig(with_plan=False)
    elapsed_s = again.session.store.status.session.elapsed_s
    assert elapsed_s > 0.5 * known.session.elapsed_s > 0, "the time before the crash is part of the session's"
    again.session.context.workers = WorkerThatLooksBack(half_way)
    again.session.take_lease(1, "anna")
    await again.session.acknowledge("anna")
    await again.session.prepare(1, Purpose.RESUME)
    await until(lambda: again.session.store.status.estimate.views == BEFORE)
    assert again.session.store.status.estimate.camera_pose == known.estimate.camera_pose
    await again.go_until(S.IDLE, purpose=Purpose.RESUME)
    assert again.session.store.status.session.elapsed_s > elapsed_s
    assert [view.index for view in sealed(again).views()] == list(range(POSES))


async def test_a_pose_that_is_captured_again_counts_as_it_is_now(half_way: Rig) -> None:
    store = half_way.session.store
    await until(lambda: store.status.estimate.views == BEFORE)
    before = store.status.estimate.camera_pose
    await half_way.session.edit(1, Retake(0))
    half_way.arm.slow = True
    await half_way.go_until(S.MOVING, purpose=Purpose.RESUME)
    await half_way.pause_after_this_pose("anna")
    await until(lambda: store.status.estimate.camera_pose != before)
    assert store.status.estimate.views == BEFORE


async def test_nothing_moves_by_poses_that_the_disk_did_not_take(
    half_way: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    moves = half_way.arm.log.count("move")
    summary = await half_way.session.prepare(1, Purpose.RESUME)
    monkeypatch.setattr("station.session.recording.write_state", full)
    await half_way.session.go(1, summary.token)
    await until(lambda: "No space left" in half_way.session.store.status.reason)
    assert half_way.state is S.PAUSED
    assert half_way.arm.log.count("move") == moves
