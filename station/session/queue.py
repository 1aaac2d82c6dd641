"""Poses of a session with their states. A pose number never changes; the order may."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from recordings.errors import CodedError
from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan, PlannedPose, plan_sha256
from station.cell.status import PoseState, PoseStatus

BUSY: frozenset[PoseState] = frozenset({"moving", "settling", "capturing", "writing"})
POSE_LIMIT = 2000
TAKE_AGAIN = "to be captured again"
STILL_COUNTS = "; its image counts until then"
NOT_AGAIN = "not captured again: its image counts"


class PoseQueue:
    """Poses in driving order. `index` is a pose's permanent number in the session, counted from 0."""

    def __init__(self, plan: Plan, restored: Sequence[PoseStatus] = ()) -> None:
        """`restored`: states after a restart, one for each pose of the plan, in its order."""
        self._plan = plan
        known = [_after_restart(status) for status in restored]
        if len(known) != len(plan.poses):
            known = [_fresh(index, pose) for index, pose in enumerate(plan.poses)]
        self._poses = {status.index: pose for status, pose in zip(known, plan.poses, strict=True)}
        self._status = {status.index: status for status in known}
        self.next_index = max(self._poses, default=-1) + 1
        """Number that the next added pose gets."""

    @property
    def plan(self) -> Plan:
        """Plan with all changes since it was loaded."""
        return msgspec.structs.replace(self._plan, poses=tuple(self._poses.values()))

    @property
    def sha256(self) -> str:
        """Hash of the plan, order included, to which an approval is bound."""
        return plan_sha256(self.plan)

    @property
    def statuses(self) -> tuple[PoseStatus, ...]:
        return tuple(self._status[i] for i in self._poses)

    @property
    def open(self) -> tuple[int, ...]:
        """Numbers of the poses still to be captured, in order."""
        return tuple(i for i in self._poses if self._status[i].state == "planned")

    @property
    def done(self) -> int:
        """Number of poses whose image counts, those to be retaken included."""
        return sum(status.counts for status in self._status.values())

    @property
    def failed(self) -> tuple[int, ...]:
        return tuple(i for i in self._poses if self._status[i].state == "failed")

    def pose(self, index: int) -> PlannedPose:
        return self._poses[index]

    def status(self, index: int) -> PoseStatus:
        """Return a pose's status. RefusedError for a number that does not exist."""
        if index not in self._status:
            raise RefusedError("no-such-pose", pose=index, number=index + 1, poses=len(self._poses))
        return self._status[index]

    def mark(self, index: int, state: PoseState, reason: str | CodedError = "") -> None:
        before = self.status(index)
        cause = reason.code if isinstance(reason, CodedError) else ""
        self._status[index] = msgspec.structs.replace(
            before,
            state=state,
            reason=str(reason),
            cause=cause,
            kept=before.counts and state != "done",
        )

    def note(self, index: int, *, corners: int | None = None, coverage: float | None = None) -> None:
        """Note corners and coverage of the image at a pose."""
        self._status[index] = msgspec.structs.replace(self.status(index), corners=corners, coverage=coverage)

    def note_estimate(self, index: int, sigma_mm: float | None) -> None:
        """Note the expected error after this pose; nothing for one that is gone meanwhile."""
        if index in self._status:
            self._status[index] = msgspec.structs.replace(self._status[index], estimated_sigma_mm=sigma_mm)

    def anew(self, guided: bool = True) -> PoseQueue:
        """Copy the queue for a new session: skipped poses stay skipped, all others are planned again.

        `guided`: include poses to which a person moved the arm by hand.
        """
        kept = {i: pose for i, pose in self._poses.items() if guided or not pose.guided}
        left_out = {i for i in kept if self._status[i].state == "skipped"}
        plan = msgspec.structs.replace(self._plan, poses=tuple(kept.values()))
        fresh = (
            msgspec.structs.replace(
                _fresh(index, pose), predicted_sigma_mm=self._status[index].predicted_sigma_mm
            )
            for index, pose in kept.items()
        )
        again = PoseQueue(plan, list(fresh))
        for index in left_out:
            again.skip(index)
        return again

    def start_attempt(self, index: int) -> int:
        """Begin an attempt; return its number, from 1. In the recording the last attempt counts."""
        attempt = self.status(index).attempt + 1
        self._status[index] = msgspec.structs.replace(self._status[index], attempt=attempt)
        return attempt

    def retake(self, index: int) -> None:
        """Plan a pose again, at its position in the order."""
        status = self.status(index)
        if status.state in BUSY:
            raise _refused("pose-busy", index)
        self.mark(index, "planned", TAKE_AGAIN + (STILL_COUNTS if status.counts else ""))

    def skip(self, index: int) -> None:
        """Skip a pose; if it has an image, only its retake is skipped, as the image stays recorded."""
        status = self.status(index)
        state = status.state
        if status.kept and state not in BUSY:
            self.mark(index, "done", NOT_AGAIN)
            return
        if state in BUSY or state == "done":
            raise _refused("pose-busy" if state in BUSY else "pose-taken", index)
        self.mark(index, "skipped", "skipped by the operator")

    def reorder(self, order: Sequence[int]) -> None:
        """Change the order; `order`: every pose number once."""
        if sorted(order) != sorted(self._poses):
            raise RefusedError("wrong-order", poses=len(self._poses))
        before = self.statuses
        self._poses = {i: self._poses[i] for i in order}
        for place, (index, was) in enumerate(zip(order, before, strict=True)):
            # Predicted errors stay valid where the set of poses up to there is unchanged.
            same = {old.index for old in before[: place + 1]} == set(order[: place + 1])
            sigma_mm = was.predicted_sigma_mm if same else None
            self._status[index] = msgspec.structs.replace(self._status[index], predicted_sigma_mm=sigma_mm)
        self._changed()

    def add(self, pose: PlannedPose) -> int:
        """Add a pose at the end; return its number."""
        if any(pose.name == other.name for other in self._poses.values()):
            raise RefusedError("pose-name", name=pose.name)
        if len(self._poses) >= POSE_LIMIT:
            raise RefusedError("too-many-poses", limit=POSE_LIMIT)
        index, self.next_index = self.next_index, self.next_index + 1
        self._poses[index] = pose
        self._status[index] = _fresh(index, pose)
        self._changed()
        return index

    def drop(self, index: int) -> None:
        """Remove a pose that was never tried."""
        status = self.status(index)
        if status.state in BUSY:
            raise _refused("pose-busy", index)
        if status.attempt:
            raise _refused("pose-tried", index)
        if len(self._poses) == 1:
            raise _refused("last-pose", index)
        places = list(self._poses)
        for behind in places[places.index(index) :]:  # their predicted errors counted on this pose
            self._status[behind] = msgspec.structs.replace(self._status[behind], predicted_sigma_mm=None)
        del self._poses[index], self._status[index]
        self._changed()

    def _changed(self) -> None:
        """Note that a person changed the plan, so that it is not replaced without asking."""
        self._plan = msgspec.structs.replace(self._plan, criterion=None)


def _refused(code: str, index: int) -> RefusedError:
    return RefusedError(code, pose=index, number=index + 1)


def _fresh(index: int, pose: PlannedPose) -> PoseStatus:
    sigma_m, view = pose.predicted_sigma_m, pose.view
    return PoseStatus(
        index,
        pose.name,
        why=pose.why,
        predicted_sigma_mm=None if sigma_m is None else round(1000 * sigma_m, 4),
        coverage=None if view is None else round(view.coverage, 4),
        base_from_flange=pose.base_from_flange,
    )


def _after_restart(old: PoseStatus) -> PoseStatus:
    """Restore a pose's status: captured ones stay done, all others are planned again."""
    kept = old.state if old.state in ("done", "skipped", "failed") else "planned"
    return msgspec.structs.replace(old, state=kept)
