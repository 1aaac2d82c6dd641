"""The poses of a session: numbers stay, refusals say why, a copy begins where it should."""

from __future__ import annotations

import msgspec
import pytest

from station.cell.pose_plan import Plan, PlannedPose
from station.session import queue as module
from station.session.queue import PoseQueue
from tests.codes import raises


def queue_of(count: int = 4) -> PoseQueue:
    poses = tuple(PlannedPose(f"p{i}", (0.1 * i, 0.0, 0.0, 0.0, 0.0, 0.0)) for i in range(count))
    return PoseQueue(Plan("UR10", "eye-in-hand", poses))


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
    assert PoseQueue(queue.plan, queue.statuses).done == 1  # after a crash on the way
    queue.mark(1, "failed", "too dark")
    assert queue.done == 1
    queue.mark(1, "done")
    assert (queue.done, queue.status(1).kept) == (1, False)


def test_another_session_leaves_out_what_was_left_out_and_on_wish_what_a_hand_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    queue = PoseQueue(msgspec.structs.replace(queue_of().plan, criterion="A"))
    assert queue.add(PlannedPose("hand-05", (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), guided=True)) == 4
    assert queue.plan.criterion is None, "no longer the planner's"
    monkeypatch.setattr(module, "POSE_LIMIT", 5)
    with raises("too-many-poses"):
        queue.add(queue.pose(4))
    with raises("no-such-pose"):
        queue.status(5)
    queue.mark(0, "done")
    queue.start_attempt(0)
    queue.skip(2)
    again = queue.anew()
    assert [status.state for status in again.statuses] == ["planned"] * 2 + ["skipped"] + ["planned"] * 2
    assert again.status(0).attempt == 0 and again.plan == queue.plan
    assert [status.name for status in queue.anew(guided=False).statuses] == ["p0", "p1", "p2", "p3"]
