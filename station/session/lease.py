"""Control by one client, and the one-use approval of a motion. Both end on any doubt."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recordings.schema.messages import Vector6
from station.cell.errors import RefusedError
from station.cell.status import APPROVAL_LIFETIME_S, LeaseStatus, MotionPreview
from station.session.motion import Motion

START_TOLERANCE_RAD = 0.005
"""Largest joint difference between where the arm stood when the motion was offered and at its start."""


class LeaseManager:
    """Manager of control, which at most one client has."""

    def __init__(self) -> None:
        self.lease = LeaseStatus()

    def take(self, client_id: int, who: str, wall_ns: int) -> LeaseStatus:
        """Give control to a client, which may already have it. RefusedError names another that has it."""
        if self.lease.client_id is None:
            self.lease = LeaseStatus(holder=who, client_id=client_id, since_wall_ns=wall_ns)
        self.require(client_id)
        return self.lease

    def release(self, client_id: int) -> bool:
        """Release control; True when this client had it."""
        if self.lease.client_id != client_id:
            return False
        self.lease = LeaseStatus()
        return True

    def require(self, client_id: int) -> None:
        """RefusedError unless this client has control."""
        if self.lease.client_id is None:
            raise RefusedError("no-control")
        if self.lease.client_id != client_id:
            raise RefusedError("control-held", holder=self.lease.holder)


@dataclass(frozen=True)
class MotionApproval:
    """Motion offered for approval: what it covers, from where, and for which client."""

    motion: Motion
    preview: MotionPreview
    client_id: int
    expires_s: float = 0.0
    again: bool = False
    """True: poses that do not settle are tried once more at the end, as no person can be asked."""
    approval: str = ""
    """Who approved it, and how."""

    @property
    def start_joints_rad(self) -> Vector6:
        assert self.preview.start_joints_rad is not None
        return self.preview.start_joints_rad

    @property
    def said(self) -> str:
        """Text on the approval for log and recording."""
        return f"{self.approval}: {self.preview.purpose}, plan {self.preview.plan_sha256[:12]}"


class ApprovalManager:
    """Manager of the one offered motion that may be approved, once, or voided."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.waiting: MotionApproval | None = None
        self.voids = 0
        """Number of times approvals were voided: a preflight check that began before may not offer one."""

    def offer(self, asked: MotionApproval) -> None:
        """Offer a motion for `APPROVAL_LIFETIME_S`; an older offer is void."""
        self.waiting = replace(asked, expires_s=self._clock() + APPROVAL_LIFETIME_S)

    def void(self) -> None:
        self.voids += 1
        self.waiting = None

    def redeem(
        self,
        token: str,
        client_id: int,
        plan_sha256: str,
        joints_rad: Sequence[float],
        again: bool = False,
    ) -> MotionApproval:
        """Return the approval, once. RefusedError when anything changed since the offer, then void."""
        asked, self.waiting = self.waiting, None
        if asked is None or not secrets.compare_digest(asked.preview.token.encode(), token.encode()):
            raise RefusedError("approval-used")
        if self._clock() > asked.expires_s:
            raise RefusedError("approval-expired", limit_s=APPROVAL_LIFETIME_S)
        if asked.client_id != client_id:
            raise RefusedError("approval-of-another")
        # A stop test does not depend on the plan. A new session's poses have the hash of those shown so far.
        if asked.motion.stop_test is None and asked.preview.plan_sha256 != plan_sha256:
            raise RefusedError("plan-changed")
        require_start(joints_rad, asked.start_joints_rad, "since the approval was asked for")
        return replace(asked, again=again)


def require_start(joints_rad: Sequence[float], start_rad: Sequence[float], when: str) -> None:
    """Raise RefusedError when joints (6,) differ from `start_rad` by more than `START_TOLERANCE_RAD`."""
    moved_rad = float(np.abs(np.subtract(joints_rad, start_rad)).max())
    if moved_rad > START_TOLERANCE_RAD:
        advice, limit_rad = "Request the approval again.", START_TOLERANCE_RAD
        raise RefusedError("arm-moved", when=when, moved_rad=moved_rad, limit_rad=limit_rad, advice=advice)
