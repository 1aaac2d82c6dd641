"""Who may command, and the one-use permission to move. Both end the moment anything is in doubt."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recordings.schema.messages import Vector6
from station.cell.errors import RefusedError
from station.cell.status import Lease, MotionPreview
from station.plan.hover import Hover
from station.protocol.verbs import Purpose
from station.session.queue import PlanRevision

APPROVAL_LIFETIME_S = 120.0
START_TOLERANCE_RAD = 0.005
"""The arm must stand where it stood when the person was asked."""


class LeaseManager:
    """At most one client holds the lease."""

    def __init__(self) -> None:
        self.lease = Lease()

    def take(self, client_id: int, who: str, wall_ns: int) -> Lease:
        """Taking it again is fine. RefusedError names the present holder."""
        if self.lease.client_id not in (None, client_id):
            raise RefusedError(
                f"control is held by {self.lease.holder}: ask them to let go (F4 on their screen); "
                "you may watch and STOP"
            )
        if self.lease.client_id is None:
            self.lease = Lease(holder=who, client_id=client_id, since_wall_ns=wall_ns)
        return self.lease

    def release(self, client_id: int) -> bool:
        """True when this client held it."""
        if self.lease.client_id != client_id:
            return False
        self.lease = Lease()
        return True

    def require(self, client_id: int) -> None:
        """RefusedError unless this client holds the lease."""
        if self.lease.client_id == client_id:
            return
        if self.lease.client_id is None:
            raise RefusedError("take the lease first: nobody commands this station right now")
        raise RefusedError(f"control is held by {self.lease.holder}; you may watch and STOP")


@dataclass(frozen=True)
class MotionApproval:
    """A permission as it was asked for."""

    summary: MotionPreview
    client_id: int
    expires_s: float
    start_joints_rad: Vector6
    poses: tuple[int, ...]
    """Pose numbers it covers, in order; more may not be driven to with it."""
    again: bool = False
    """Nobody is there to be asked: poses that do not come to rest are tried once more at the end."""
    purpose: Purpose | None = None
    """None: a hover."""
    replanned: PlanRevision | None = None
    """Poses that take the place of the session's with this go."""
    hover: Hover | None = None
    """A way over one corner of the board instead of poses of the plan."""
    approval: str = ""
    """Who approved it, and how."""

    @property
    def said(self) -> str:
        """For log and recording."""
        return f"{self.approval}: {self.summary.purpose}, plan {self.summary.plan_sha256[:12]}"


class ApprovalManager:
    """At most one go waits for a person; redeeming or voiding destroys it."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._waiting: MotionApproval | None = None
        self.voids = 0
        """How often a go was made void: a check that was under way meanwhile offers none."""

    @property
    def waiting(self) -> MotionApproval | None:
        return self._waiting

    @staticmethod
    def new_token() -> str:
        return secrets.token_urlsafe(16)

    def offer(
        self,
        summary: MotionPreview,
        client_id: int,
        poses: tuple[int, ...],
        hover: Hover | None = None,
        purpose: Purpose | None = None,
        replanned: PlanRevision | None = None,
    ) -> MotionApproval:
        """From where the summary begins. An older one is void."""
        start = summary.start_joints_rad
        assert start is not None
        expires_s = self._clock() + APPROVAL_LIFETIME_S
        self._waiting = MotionApproval(
            summary, client_id, expires_s, start, poses, purpose=purpose, hover=hover, replanned=replanned
        )
        return self._waiting

    def void(self) -> bool:
        """True when there was one."""
        self.voids += 1
        was, self._waiting = self._waiting, None
        return was is not None

    def redeem(
        self,
        token: str,
        client_id: int,
        plan_sha256: str,
        joints_rad: Sequence[float],
        again: bool = False,
    ) -> MotionApproval:
        """The go, once. RefusedError says what changed since the person was asked; the go is void then."""
        go, self._waiting = self._waiting, None
        if go is None or not secrets.compare_digest(go.summary.token.encode(), token.encode()):
            raise RefusedError("this go is not valid (used, stopped or replaced): prepare again and confirm")
        if self._clock() > go.expires_s:
            raise RefusedError(
                f"this go is older than {APPROVAL_LIFETIME_S:.0f} s: prepare again and confirm"
            )
        if go.client_id != client_id:
            raise RefusedError("this go was asked for by another client: prepare again and confirm")
        asked_for = go.replanned.before_sha256 if go.replanned else go.summary.plan_sha256
        if go.hover is None and asked_for != plan_sha256:  # a hover carries its own plan
            raise RefusedError("the plan changed since this go was asked for: prepare again and confirm")
        moved_rad = float(np.abs(np.subtract(joints_rad, go.start_joints_rad)).max())
        if moved_rad > START_TOLERANCE_RAD:
            raise RefusedError(
                f"the arm moved by {np.rad2deg(moved_rad):.1f}° since this go was asked for: "
                "prepare again and confirm"
            )
        return replace(go, again=again)
