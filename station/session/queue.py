"""The poses of a session and what became of each. Pose numbers never change; the order may."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from recordings.errors import CodedError
from station.cell.errors import RefusedError
from station.cell.plan import Plan, PlannedPose, plan_sha256
from station.cell.status import PoseState, PoseStatus
from station.protocol.verbs import Purpose

BUSY: frozenset[PoseState] = frozenset({"moving", "settling", "capturing", "writing"})
POSE_LIMIT = 2000
TAKE_AGAIN = "to be captured again"
STILL_COUNTS = "; its image counts until then"
NOT_AGAIN = "not captured again: its image counts"


@dataclass(frozen=True, eq=False)
class OfferedPoses:
    """Poses that wait for a person's approval."""

    purpose: Purpose
    queue: PoseQueue
    poses: tuple[int, ...]
    """Those that the approval covers, in order."""
    before_sha256: str
    """Hash of the poses that are shown until then."""


class PoseQueue:
    """Poses in driving order. `index` is a pose's number in the session, counted from 0, for ever."""

    def __init__(self, plan: Plan, restored: Sequence[PoseStatus] = ()) -> None:
        """`restored`: after a restart, one for each pose of the plan, in its order."""
        self._plan = plan
        known = [_after_restart(status) for status in restored]
        if len(known) != len(plan.poses):
            known = [_fresh(index, pose) for index, pose in enumerate(plan.poses)]
        self._poses = {status.index: pose for status, pose in zip(known, plan.poses, strict=True)}
        self._status = {status.index: status for status in known}
        self.next_index = max(self._poses, default=-1) + 1
        """The number that a further pose will have."""

    @property
    def plan(self) -> Plan:
        """Return the plan with every change that was made since it was loaded."""
        return msgspec.structs.replace(self._plan, poses=tuple(self._poses.values()))

    @property
    def sha256(self) -> str:
        """Hash of the plan and its order: an approval is bound to it."""
        return plan_sha256(self.plan)

    @property
    def statuses(self) -> tuple[PoseStatus, ...]:
        return tuple(self._status[i] for i in self._poses)

    @property
    def open(self) -> tuple[int, ...]:
        """Poses still to be driven to, in order."""
        return tuple(i for i in self._poses if self._status[i].state == "planned")

    @property
    def done(self) -> int:
        """Poses whose image counts, those that are to be taken again included."""
        return sum(status.counts for status in self._status.values())

    @property
    def failed(self) -> tuple[int, ...]:
        return tuple(i for i in self._poses if self._status[i].state == "failed")

    def pose(self, index: int) -> PlannedPose:
        return self._poses[index]

    def status(self, index: int) -> PoseStatus:
        """RefusedError for a number that does not exist."""
        if index not in self._status:
            text = f"There is no pose {index + 1}; the plan has {len(self._poses)}."
            raise RefusedError(text, code="no-such-pose", pose=index, poses=len(self._poses))
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
        """Notes what the image showed."""
        self._status[index] = msgspec.structs.replace(self.status(index), corners=corners, coverage=coverage)

    def note_estimate(self, index: int, sigma_mm: float | None) -> None:
        """Note the expected error after this pose; nothing for one that is gone meanwhile."""
        if index in self._status:
            self._status[index] = msgspec.structs.replace(self._status[index], estimated_sigma_mm=sigma_mm)

    def anew(self, guided: bool = True) -> PoseQueue:
        """A copy for another session: what is skipped stays left out, all else is planned once more.

        `guided`: with the places that a hand brought the arm to.
        """
        kept = {i: pose for i, pose in self._poses.items() if guided or not pose.guided}
        left_out = {i for i in kept if self._status[i].state == "skipped"}
        plan = msgspec.structs.replace(self._plan, poses=tuple(kept.values()))
        again = PoseQueue(plan, [_fresh(index, pose) for index, pose in kept.items()])
        for index in left_out:
            again.skip(index)
        return again

    def start_attempt(self, index: int) -> int:
        """The number of this attempt, from 1; later ones supersede earlier ones in the recording."""
        attempt = self.status(index).attempt + 1
        self._status[index] = msgspec.structs.replace(self._status[index], attempt=attempt)
        return attempt

    def retake(self, index: int) -> None:
        """Plans it once more, where it stands in the order."""
        status = self.status(index)
        if status.state in BUSY:
            raise _refused("pose-busy", index, "is being taken right now")
        self.mark(index, "planned", TAKE_AGAIN + (STILL_COUNTS if status.counts else ""))

    def skip(self, index: int) -> None:
        """Leaves it out; of one that has an image only the retake, for the recording keeps the image."""
        status = self.status(index)
        state = status.state
        if status.kept and state not in BUSY:
            self.mark(index, "done", NOT_AGAIN)
            return
        if state in BUSY or state == "done":
            text = f"is {state}: only a pose that waits or failed can be skipped"
            raise _refused("pose-busy" if state in BUSY else "pose-taken", index, text)
        self.mark(index, "skipped", "skipped by the operator")

    def reorder(self, order: Sequence[int]) -> None:
        """`order`: every pose number once."""
        if sorted(order) != sorted(self._poses):
            text = f"An order names each of the {len(self._poses)} poses exactly once."
            raise RefusedError(text, code="wrong-order")
        before = self.statuses
        self._poses = {i: self._poses[i] for i in order}
        for place, (index, was) in enumerate(zip(order, before, strict=True)):
            # An error is expected after all poses so far: it holds where these are the same as before.
            same = {old.index for old in before[: place + 1]} == set(order[: place + 1])
            sigma_mm = was.predicted_sigma_mm if same else None
            self._status[index] = msgspec.structs.replace(self._status[index], predicted_sigma_mm=sigma_mm)
        self._changed()

    def add(self, pose: PlannedPose) -> int:
        """At the end; returns its number."""
        if any(pose.name == other.name for other in self._poses.values()):
            raise RefusedError(f"There is already a pose named '{pose.name}'.", code="pose-name")
        if len(self._poses) >= POSE_LIMIT:
            raise RefusedError(f"A session has at most {POSE_LIMIT} poses.", code="too-many-poses")
        index, self.next_index = self.next_index, self.next_index + 1
        self._poses[index] = pose
        self._status[index] = _fresh(index, pose)
        self._changed()
        return index

    def drop(self, index: int) -> None:
        """Forgets a pose that was never taken."""
        status = self.status(index)
        if status.state in BUSY:
            raise _refused("pose-busy", index, "is being taken right now")
        if status.attempt:
            raise _refused("pose-tried", index, "was already tried", "Skip it instead.")
        if len(self._poses) == 1:
            raise _refused("last-pose", index, "is the last one", "Finish the session instead.")
        del self._poses[index], self._status[index]
        self._changed()

    def _changed(self) -> None:
        """Note that a person changed the plan: no other takes its place unasked."""
        self._plan = msgspec.structs.replace(self._plan, criterion=None)


def _refused(code: str, index: int, what: str, remedy: str = "") -> RefusedError:
    return RefusedError(f"Pose {index + 1} {what}.", code=code, remedy=remedy, pose=index)


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
    """Keeps what was on the disk; all else is planned again."""
    kept = old.state if old.state in ("done", "skipped", "failed") else "planned"
    return msgspec.structs.replace(old, state=kept)
