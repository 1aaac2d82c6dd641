"""The approval: one use, and void at the first doubt."""

from __future__ import annotations

import secrets

import pytest

from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan
from station.cell.status import MotionPreview
from station.protocol.verbs import Purpose
from station.session.motion import (
    APPROVAL_LIFETIME_S,
    START_TOLERANCE_RAD,
    ApprovalManager,
    Motion,
    MotionApproval,
)
from station.session.queue import PoseQueue
from tests.codes import raises

HERE = (0.0, -1.5, 1.5, -1.5, -1.5, 0.0)
PLAN = "ab" * 32


class Clock:
    now_s = 50.0

    def __call__(self) -> float:
        return self.now_s


def offered(manager: ApprovalManager, client_id: int = 1) -> MotionApproval:
    preview = MotionPreview(
        secrets.token_urlsafe(16), "run plan", PLAN, 4, 1.0, 0.5, 0.2, 30.0, "84 mm and 22° to pose 1"
    )
    motion = Motion(Purpose.RUN, PoseQueue(Plan("UR10", "eye-in-hand", ())), (0, 1, 2, 3))
    manager.offer(MotionApproval(motion, preview, client_id, HERE))
    return manager.waiting


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"token": "guess"}, "approval-used"),
        ({"client_id": 2}, "approval-of-another"),
        ({"plan": "cd" * 32}, "plan-changed"),
        ({"joints": (0.0, -1.5, 1.5 + 2 * START_TOLERANCE_RAD, -1.5, -1.5, 0.0)}, "arm-moved"),
        ({"later_s": APPROVAL_LIFETIME_S + 1}, "approval-expired"),
    ],
)
def test_a_go_is_bound_to_what_was_shown_and_a_wrong_try_voids_it(
    change: dict[str, object], code: str
) -> None:
    clock = Clock()
    manager = ApprovalManager(clock)
    token = offered(manager).preview.token
    clock.now_s += float(change.get("later_s", 0))
    with raises(code):
        manager.redeem(
            change.get("token", token),
            change.get("client_id", 1),
            change.get("plan", PLAN),
            change.get("joints", HERE),
        )
    with pytest.raises(RefusedError):
        manager.redeem(token, 1, PLAN, HERE)
