"""The plan gets better while it is carried out: poses that are left, planned anew, or one that helps most.

Both are offered to a person and become the session's by that person's go only.
"""

from __future__ import annotations

import contextlib
import math

import msgspec
import numpy as np

from recordings.errors import RecordingError
from station.analysis.estimation import Seen, next_best
from station.analysis.improvement import FEWEST_LEFT, FEWEST_VIEWS, Improvement, improve
from station.cell.errors import RefusedError
from station.cell.status import EstimateStatus
from station.plan.predict import Advice
from station.protocol.verbs import Purpose
from station.session.context import SessionContext
from station.session.interrupted import look_back
from station.session.patience import RestingCheck
from station.session.queue import PlanRevision, PoseQueue

_SHARPER = 4.0
"""So many times sharper the mount must be known than when the plan was made, to speak of it."""
_PLAN_S = 120.0


class Replanner:
    """Says when it would be worth it, and makes the offer."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._improved = ""
        """The session whose plan was improved already: once is told, more may be asked for."""

    def hint(self, estimate: EstimateStatus) -> str:
        """What to tell a person when it would be worth it; empty = nothing."""
        queue, config = self._context.queue, self._context.cell.config
        sigma_mm, guess = estimate.sigma_translation_mm, config.camera_guess
        if queue is None or sigma_mm is None or guess is None:
            return ""
        times = 1000 * guess.sigma_m / sigma_mm
        if estimate.views < FEWEST_VIEWS or len(queue.fresh) < FEWEST_LEFT or times < _SHARPER:
            return ""
        if self._context.recording is None or self._context.recording.name == self._improved:
            return ""
        return (
            f"the mount is known {times:.0f} times better than the guess the poses were planned from: pause, "
            f"then `station improve` (p on the plan screen) plans the {len(queue.fresh)} that are left anew"
        )

    async def replan(self, purpose: Purpose) -> PlanRevision | None:
        """The poses that this purpose would put in place of the session's; None when it changes none.

        Nothing moves, and nothing is changed yet; what a restart forgot is read again first. RefusedError
        when it is too early, too late or not worth it; LimitError when no such poses exist.
        """
        context = self._context
        await look_back(context)
        if purpose not in (Purpose.REPLAN, Purpose.NEXT_POSE):
            return None
        if context.recording is None or context.queue is None:
            raise RefusedError("no session is open: run the plan, and pause after its first pictures")
        if context.queue.plan.motion != "stops":
            raise RefusedError("a sweep has no poses to improve")
        if not context.seen and context.queue.done:
            raise RefusedError(
                "what the pictures from before the daemon's restart show could not be read: go on with the "
                f"plan as it is (`station resume`), and ask again after {FEWEST_VIEWS} more"
            )
        await RestingCheck(context.cell.robot.check).news()
        return await (
            self._anew(context.queue) if purpose is Purpose.REPLAN else self._one_more(context.queue)
        )

    async def _anew(self, queue: PoseQueue) -> PlanRevision:
        """The poses with those left planned anew."""
        context, robot = self._context, self._context.cell.robot
        fresh = queue.fresh
        if len(fresh) < FEWEST_LEFT:
            raise RefusedError(f"{len(fresh)} poses are left: too few to plan them anew")
        before = [queue.pose(index) for index in queue.open if index not in fresh]
        start = before[-1].joints_rad if before else robot.latest().joints_rad
        left = msgspec.structs.replace(queue.plan, poses=tuple(queue.pose(index) for index in fresh))
        seen: list[Seen] = [(v.index, v.base_from_flange, v.indices, v.pixels) for v in context.seen.values()]
        known = context.cell.camera_model is not None
        config = context.cell.config
        found = await context.workers.call(improve, config, known, seen, left, start, timeout_s=_PLAN_S)
        if not is_worth_it(found):
            raise RefusedError(f"nothing to gain, go on with the plan as it is ({'; '.join(changes(found))})")
        better = queue.with_fresh(found.plan.poses)
        return PlanRevision(Purpose.REPLAN, better, better.open, queue.sha256, changes(found))

    async def _one_more(self, queue: PoseQueue) -> PlanRevision:
        """The poses and the one that would help most after those captured."""
        context = self._context
        if not context.seen:
            raise RefusedError("no picture counts yet: what would help most is not known")
        flange = np.array([view.base_from_flange for view in context.seen.values()])
        here = context.cell.robot.latest().joints_rad
        onward = queue.pose(queue.open[0]).joints_rad if queue.open else None
        found = await context.workers.call(
            next_best, context.cell.config, flange, here, onward, timeout_s=_PLAN_S
        )
        if found.next_pose is None:
            raise RefusedError(found.text)
        more, index = queue.with_more(found.next_pose)
        return PlanRevision(Purpose.NEXT_POSE, more, (index,), queue.sha256, what_it_brings(found, index))

    def adopt(self, found: PlanRevision) -> None:
        """A person said yes: these are the poses now, and the recording says so."""
        context, recording = self._context, self._context.recording
        context.queue = found.queue
        context.show_poses()
        if recording is None:
            return  # the loaded plan, for a session that begins
        if found.purpose is Purpose.REPLAN:
            self._improved = recording.name
        context.store.event("; ".join(found.changes))
        with contextlib.suppress(RecordingError):  # a disk that fails is told by the next picture
            recording.attach_plan(found.queue.plan)


def what_it_brings(found: Advice, index: int) -> tuple[str, ...]:
    """What a person is told of one pose more."""
    pose = found.next_pose
    assert pose is not None and pose.predicted_sigma_m is not None
    return (
        f"added as pose {index + 1}: {pose.why}",
        f"expected error: {1000 * found.now.sigma_m:.2f} → {1000 * pose.predicted_sigma_m:.2f} mm",
    )


def is_worth_it(found: Improvement) -> bool:
    """Fewer cut boards, a smaller expected error or a better covered picture."""
    before, after = found.before, found.after
    if after.cut != before.cut:
        return after.cut < before.cut
    return after.sigma_m < 0.97 * before.sigma_m or after.margin_px < before.margin_px - 30


def changes(found: Improvement) -> tuple[str, ...]:
    """What a person is told, before → after."""
    before, after = found.before, found.after
    cut = (f"poses that would cut the board: {before.cut} → {after.cut}",) if before.cut or after.cut else ()
    known = f"{1000 * found.sigma_m:.1f} mm and {math.degrees(found.sigma_rad):.2f}°"
    return (
        f"planned anew: {len(found.plan.poses)} poses, from a mount known to {known}",
        f"expected error at the end: {1000 * before.sigma_m:.2f} → {1000 * after.sigma_m:.2f} mm",
        f"empty strip along the picture's edges: {before.margin_px:.0f} → {after.margin_px:.0f} px",
        *cut,
    )
