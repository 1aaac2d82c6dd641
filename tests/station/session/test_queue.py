"""The poses of a session: numbers stay, refusals say why, a copy begins where it should."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import pytest

from station.cell.pose_plan import Plan, PlannedPose
from station.cell.status import PoseState
from station.session import queue as module
from station.session.queue import BUSY, PoseQueue
from tests.codes import raises


def queue_of(count: int = 4) -> PoseQueue:
    poses = tuple(PlannedPose(f"p{i}", (0.1 * i, 0.0, 0.0, 0.0, 0.0, 0.0)) for i in range(count))
    return PoseQueue(Plan("UR10", "eye-in-hand", poses))


def pose(name: str, guided: bool = False) -> PlannedPose:
    return PlannedPose(name, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), guided=guided)


@pytest.mark.parametrize(
    "change",
    [lambda q: q.reorder((1, 0, 2, 3)), lambda q: q.drop(1), lambda q: q.add(pose("own"))],
    ids=["reordered", "dropped", "added"],
)
def test_a_plan_that_a_person_changed_is_no_longer_the_planners(change: Callable[[PoseQueue], None]) -> None:
    queue = PoseQueue(msgspec.structs.replace(queue_of().plan, criterion="A"))
    queue.skip(3)
    assert queue.plan.criterion == "A"
    change(queue)
    assert queue.plan.criterion is None


def test_an_error_stays_expected_after_the_same_poses_in_another_order() -> None:
    plan = queue_of().plan
    poses = [msgspec.structs.replace(p, predicted_sigma_m=1 / (i + 1)) for i, p in enumerate(plan.poses)]
    queue = PoseQueue(msgspec.structs.replace(plan, poses=tuple(poses)))
    before = [status.predicted_sigma_mm for status in queue.statuses]
    queue.reorder((2, 0, 1, 3))
    assert [s.predicted_sigma_mm for s in queue.statuses] == [None, None, before[2], before[3]]
    queue.drop(1)  # the third one
    for now in (queue, queue.anew()):
        assert [s.predicted_sigma_mm for s in now.statuses] == [None, None, None]


@pytest.mark.parametrize("state", sorted(BUSY))
def test_a_pose_that_is_being_taken_is_left_alone(state: PoseState) -> None:
    queue = queue_of()
    queue.mark(1, state)
    for change in (queue.retake, queue.skip, queue.drop):
        with raises("pose-busy"):
            change(1)
    assert queue.status(1).state == state


def test_an_image_counts_until_another_takes_its_place() -> None:
    queue = queue_of()
    queue.mark(1, "done")
    with raises("pose-taken"):
        queue.skip(1)
    queue.retake(1)
    assert (queue.done, queue.status(1).kept, queue.open) == (1, True, (0, 1, 2, 3))
    queue.skip(1)  # only its retake: the recording has the image
    assert (queue.status(1).state, queue.open) == ("done", (0, 2, 3))
    queue.retake(1)
    queue.mark(1, "moving")
    assert PoseQueue(queue.plan, queue.statuses).done == 1  # after a crash on the way
    queue.mark(1, "failed", "too dark")
    assert queue.done == 1
    queue.mark(1, "done")
    assert (queue.done, queue.status(1).kept) == (1, False)


def test_a_pose_that_was_tried_is_not_forgotten_and_the_last_one_stays() -> None:
    queue = queue_of(2)
    assert queue.start_attempt(0) == 1
    assert queue.start_attempt(0) == 2
    with raises("pose-tried"):
        queue.drop(0)
    queue.drop(1)
    with raises("pose-tried"):
        queue.drop(0)
    with raises("last-pose"):
        queue_of(1).drop(0)


def test_numbers_and_names_are_never_given_twice_and_there_is_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    queue = queue_of(2)
    assert queue.add(pose("a")) == 2
    queue.drop(2)
    assert queue.add(pose("b")) == 3
    assert [status.index for status in queue.statuses] == [0, 1, 3]
    with raises("no-such-pose"):
        queue.status(2)
    with raises("pose-name"):
        queue.add(pose("p1"))
    monkeypatch.setattr(module, "POSE_LIMIT", 3)
    with raises("too-many-poses"):
        queue.add(pose("c"))


@pytest.mark.parametrize("order", [[0, 1, 2], [0, 1, 2, 2], [0, 1, 2, 3, 4], [4, 3, 2, 1]])
def test_an_order_names_every_pose_once(order: list[int]) -> None:
    queue = queue_of()
    before = queue.sha256
    with raises("wrong-order"):
        queue.reorder(order)
    assert queue.sha256 == before
    queue.reorder([3, 2, 1, 0])
    assert queue.sha256 != before and queue.open == (3, 2, 1, 0)


@pytest.mark.parametrize("state", ["done", "skipped", "failed", "moving", "settling", "capturing", "writing"])
def test_after_a_restart_only_what_ended_counts(state: PoseState) -> None:
    queue = queue_of()
    queue.mark(2, state, "because")
    again = PoseQueue(queue.plan, queue.statuses)
    assert again.status(2).state == (state if state in ("done", "skipped", "failed") else "planned")
    assert again.sha256 == queue.sha256


def test_another_session_leaves_out_what_was_left_out_and_on_wish_what_a_hand_found() -> None:
    queue = queue_of()
    queue.add(pose("hand-01", guided=True))
    queue.mark(0, "done")
    queue.start_attempt(0)
    queue.skip(2)
    again = queue.anew()
    assert [status.state for status in again.statuses] == [
        "planned",
        "planned",
        "skipped",
        "planned",
        "planned",
    ]
    assert again.status(0).attempt == 0
    assert [status.index for status in queue.anew(guided=False).statuses] == [0, 1, 2, 3]
