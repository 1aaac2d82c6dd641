"""Poses of a session with their states, in driving order. A pose's number is its place, counted from 0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from recordings.errors import CodedError
from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan, PlannedPose
from station.cell.status import PoseState, PoseStatus

POSE_LIMIT = 2000
TAKE_AGAIN = "to be captured again"
STILL_COUNTS = "; its image counts until then"
TAKEN_BACK = "taken back by the operator"
NOT_AGAIN = "not captured again: its image counts"


class PoseQueue:
    """Poses in driving order."""

    def __init__(self, plan: Plan, restored: Sequence[PoseStatus] = ()) -> None:
        """`restored`: states after a restart."""
        self.plan = plan
        """Plan with the poses added since it was loaded."""
        self._statuses = [_planned(plan, index) for index in range(len(plan.poses))]
        if [status.index for status in restored] == list(range(len(plan.poses))):
            self._statuses = list(restored)

    @property
    def statuses(self) -> tuple[PoseStatus, ...]:
        return tuple(self._statuses)

    @property
    def open(self) -> tuple[int, ...]:
        """Numbers of the poses still to be captured, in order."""
        return tuple(status.index for status in self._statuses if status.state == "planned")

    @property
    def done(self) -> int:
        """Number of poses whose image counts, those to be retaken included."""
        return sum(status.counts for status in self._statuses)

    @property
    def failed(self) -> tuple[int, ...]:
        return tuple(status.index for status in self._statuses if status.state == "failed")

    @property
    def skipped(self) -> tuple[int, ...]:
        return tuple(status.index for status in self._statuses if status.state == "skipped")

    @property
    def predicted(self) -> tuple[int, ...]:
        """Numbers of the poses that the plan's error counts: neither skipped nor failed."""
        return tuple(s.index for s in self._statuses if s.state == "planned" or s.counts)

    @property
    def planned_errors_m(self) -> dict[int, float]:
        """Pose number → placed-point error after it, as planned; without poses that have none."""
        errors_m = {index: self.plan.predicted_error_m(index) for index in range(len(self.plan.poses))}
        return {index: error_m for index, error_m in errors_m.items() if error_m is not None}

    def predict(self, errors_m: Mapping[int, float]) -> None:
        """Set the predicted errors: pose number → placed-point error after it; other poses have none."""
        for index in range(len(self._statuses)):
            self.note(index, predicted_sigma_mm=_mm(errors_m.get(index)))

    def pose(self, index: int) -> PlannedPose:
        return self.plan.poses[index]

    def status(self, index: int) -> PoseStatus:
        """Return a pose's status. RefusedError for a number that does not exist."""
        if not 0 <= index < len(self._statuses):
            raise RefusedError("no-such-pose", pose=index, number=index + 1, poses=len(self._statuses))
        return self._statuses[index]

    def mark(self, index: int, state: PoseState, reason: str | CodedError = "") -> None:
        kept = self.status(index).counts and state != "done"
        cause = reason.code if isinstance(reason, CodedError) else ""
        self.note(index, state=state, reason=str(reason), cause=cause, kept=kept)

    def note(self, index: int, **fields: object) -> None:
        """Change fields of a pose's status."""
        self._statuses[index] = msgspec.structs.replace(self.status(index), **fields)

    def anew(self, guided: bool = True) -> PoseQueue:
        """Copy the queue for a new session: skipped poses stay skipped, all others are planned again.

        `guided`: include poses to which a person moved the arm by hand.
        """
        kept = [s for s in self._statuses if guided or not self.pose(s.index).guided]
        again = PoseQueue(msgspec.structs.replace(self.plan, poses=tuple(self.pose(s.index) for s in kept)))
        for index, before in enumerate(kept):
            if before.state == "skipped":
                again.skip(index)
        return again

    def start_attempt(self, index: int) -> int:
        """Begin an attempt; return its number, from 1. In the recording the last attempt counts."""
        attempt = self.status(index).attempt + 1
        self.note(index, attempt=attempt)
        return attempt

    def retake(self, index: int) -> None:
        """Plan a pose again, at its place in the order."""
        self.mark(index, "planned", TAKE_AGAIN + (STILL_COUNTS if self.status(index).counts else ""))

    def skip(self, index: int) -> None:
        """Skip a pose; if it has an image, only its retake is skipped, as the image stays recorded."""
        status = self.status(index)
        if status.kept:
            self.mark(index, "done", NOT_AGAIN)
            return
        if status.state == "done":
            raise refused("pose-taken", index)
        self.mark(index, "skipped", "skipped by the operator")

    def take_back(self, index: int) -> None:
        """Let the image of a pose that is done count no more. RefusedError where there is none."""
        if not self.status(index).counts:
            raise refused("pose-not-taken", index)
        self.note(index, state="skipped", reason=TAKEN_BACK, kept=False)

    def drop_last(self) -> None:
        """Remove the last pose, of which there is no image."""
        self.plan = msgspec.structs.replace(self.plan, poses=self.plan.poses[:-1])
        del self._statuses[-1]

    def add(self, pose: PlannedPose) -> int:
        """Add a pose at the end; return its number."""
        index = len(self._statuses)
        if index >= POSE_LIMIT:
            raise RefusedError("too-many-poses", limit=POSE_LIMIT)
        # Without the planner's criterion, so that the plan is not replaced without asking.
        self.plan = msgspec.structs.replace(self.plan, poses=(*self.plan.poses, pose), criterion=None)
        self._statuses.append(_planned(self.plan, index))
        return index


def refused(code: str, index: int) -> RefusedError:
    return RefusedError(code, pose=index, number=index + 1)


def _planned(plan: Plan, index: int) -> PoseStatus:
    pose, sigma_m = plan.poses[index], plan.predicted_error_m(index)
    return PoseStatus(
        index,
        pose.name,
        why=pose.why,
        predicted_sigma_mm=_mm(sigma_m),
        base_from_flange=pose.base_from_flange,
    )


def _mm(length_m: float | None) -> float | None:
    return None if length_m is None else round(1000 * length_m, 4)
