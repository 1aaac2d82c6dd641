"""Improves the plan while it is carried out: the running estimate, remaining poses replanned, a next pose.

Poses are offered to a person and become the session's by that person's approval only.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable

import msgspec
import numpy as np

from recordings.errors import RecordingError
from station.analysis.estimation import running_estimate, seen_before
from station.analysis.improvement import FEWEST_LEFT, FEWEST_VIEWS, Improvement, improve
from station.analysis.pool import WorkerError
from station.cell.errors import RefusedError
from station.cell.status import EstimateStatus
from station.plan.predict import Advice, next_best, next_best_text
from station.protocol.verbs import Purpose
from station.session.context import SessionContext
from station.session.queue import PlanRevision, PoseQueue
from station.session.recording import stamps_now

_LOOK_BACK_S = 120.0

_SHARPER = 4.0
"""So many times sharper the mount must be known than when the plan was made, to speak of it."""
_PLAN_S, _ESTIMATE_S = 120.0, 20.0

log = logging.getLogger(__name__)


class Replanner:
    """Says when it would be worth it, and makes the offer."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._improved = ""
        """The session whose plan was improved already: once is told, more may be asked for."""

    def hint(self, estimate: EstimateStatus) -> str:
        """A sentence for a person when replanning would help; empty: it would not."""
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
            f"The camera pose is known {times:.0f} times better than when the poses were planned. Pause, "
            f"then `station replan` (p on the plan screen) plans the remaining {len(queue.fresh)} again."
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
            remedy = "Run the plan, and pause after its first images."
            raise RefusedError("No session is open.", code="no-session", remedy=remedy)
        if context.queue.plan.motion != "stops":
            raise RefusedError("A sweep has no poses to replan.", code="sweep")
        if not context.seen and context.queue.done:
            raise RefusedError(
                "The images from before the daemon's restart could not be read.",
                code="images-unread",
                remedy="Continue with the plan as it is (`station resume`), and ask again after "
                f"{FEWEST_VIEWS} more.",
            )
        await context.arm()
        return await (
            self._anew(context.queue) if purpose is Purpose.REPLAN else self._one_more(context.queue)
        )

    async def _anew(self, queue: PoseQueue) -> PlanRevision:
        """The poses with those left planned anew."""
        context, robot = self._context, self._context.cell.robot
        fresh = queue.fresh
        if len(fresh) < FEWEST_LEFT:
            text = f"{len(fresh)} poses are left (limit {FEWEST_LEFT})."
            raise RefusedError(text, code="too-few-left", poses=len(fresh), limit=FEWEST_LEFT)
        before = [queue.pose(index) for index in queue.open if index not in fresh]
        start = before[-1].joints_rad if before else robot.latest().joints_rad
        left = msgspec.structs.replace(queue.plan, poses=tuple(queue.pose(index) for index in fresh))
        seen = list(context.seen.values())
        known = context.cell.camera_model is not None
        config = context.cell.config
        found = await context.workers.call(improve, config, known, seen, left, start, timeout_s=_PLAN_S)
        if not is_worth_it(found):
            text = f"Nothing to gain ({'; '.join(changes(found))})."
            raise RefusedError(text, code="no-gain", remedy="Continue with the plan as it is.")
        better = queue.with_fresh(found.plan.poses)
        return PlanRevision(Purpose.REPLAN, better, better.open, queue.sha256, changes(found))

    async def _one_more(self, queue: PoseQueue) -> PlanRevision:
        """The poses and the one that would help most after those captured."""
        context = self._context
        if not context.seen:
            raise RefusedError("No image counts yet: the next pose is not known.", code="nothing-captured")
        flange = np.array([view.base_from_flange for view in context.seen.values()])
        here = context.cell.robot.latest().joints_rad
        onward = queue.pose(queue.open[0]).joints_rad if queue.open else None
        found = await context.workers.call(
            next_best, context.cell.config, flange, here, onward, timeout_s=_PLAN_S
        )
        if found.next_pose is None:
            raise RefusedError(found.text, code="no-gain")
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
        context.store.event("replanned", "; ".join(found.changes), purpose=found.purpose.value)
        with contextlib.suppress(RecordingError):  # a disk that fails is told by the next image
            recording.attach_plan(found.queue.plan)


def what_it_brings(found: Advice, index: int) -> tuple[str, ...]:
    """Lines for a person on one pose more."""
    pose = found.next_pose
    assert pose is not None and pose.predicted_sigma_m is not None
    return (
        f"added as pose {index + 1}: {pose.why}",
        f"expected error: {1000 * found.sigma_m:.2f} → {1000 * pose.predicted_sigma_m:.2f} mm",
    )


def is_worth_it(found: Improvement) -> bool:
    """Fewer cut boards, a smaller expected error or a better covered image."""
    before, after = found.before, found.after
    if after.cut != before.cut:
        return after.cut < before.cut
    return after.sigma_m < 0.97 * before.sigma_m or after.margin_px < before.margin_px - 30


def changes(found: Improvement) -> tuple[str, ...]:
    """Lines for a person, before → after."""
    before, after = found.before, found.after
    cut = (f"poses that would cut the board: {before.cut} → {after.cut}",) if before.cut or after.cut else ()
    known = f"{1000 * found.sigma_m:.1f} mm and {math.degrees(found.sigma_rad):.2f}°"
    return (
        f"replanned: {len(found.plan.poses)} poses, from a camera pose known to {known}",
        f"expected error at the end: {1000 * before.sigma_m:.2f} → {1000 * after.sigma_m:.2f} mm",
        f"empty strip along the image's edges: {before.margin_px:.0f} → {after.margin_px:.0f} px",
        *cut,
    )


class Estimator:
    """Keeps the running estimate fresh: one look in the worker after each pose, never two at once."""

    def __init__(
        self, context: SessionContext, hint: Callable[[EstimateStatus], str] = lambda estimate: ""
    ) -> None:
        """`hint`: what else to tell a person about an estimate."""
        self._context, self._hint = context, hint
        self._known: tuple[int, ...] = ()
        self._woken = asyncio.Event()

    def poke(self) -> None:
        """Something changed; cheap."""
        if tuple(self._context.seen) != self._known:
            self._woken.set()

    async def run(self) -> None:
        context, config = self._context, self._context.cell.config
        while True:
            await self._woken.wait()
            self._woken.clear()
            self._known = tuple(context.seen)
            if not self._known:
                context.store.update(estimate=EstimateStatus())
                continue
            camera = config.camera.model
            if camera is None or camera.matrix is None:
                continue
            try:
                estimate = await self._estimate()
            except Exception as error:  # this task looks on; it must outlive every image and every defect
                if not isinstance(error, WorkerError):
                    log.exception("the running estimate failed")
                context.store.problem(error, said="no running estimate: {}")
                continue
            hint = self._hint(estimate)
            if hint and not context.store.status.estimate.improve:
                context.store.event("replan-helps", hint)
            context.store.update(estimate=msgspec.structs.replace(estimate, improve=hint))
            if (queue := context.queue) is not None:
                queue.note_estimate(self._known[-1], estimate.sigma_translation_mm)
                context.store.update_session(poses=queue.statuses)
            if (recording := context.recording) is not None:
                with contextlib.suppress(RecordingError):  # a full disk ends the run, not this look
                    recording.show_frames(estimate.camera_pose, estimate.board_pose, stamps_now())

    async def _estimate(self) -> EstimateStatus:
        """Estimate with advice on the next pose, where one more would help."""
        context, config = self._context, self._context.cell.config
        seen = list(context.seen.values())
        known = context.cell.camera_model is not None
        estimate = await context.workers.call(running_estimate, config, known, seen, timeout_s=_ESTIMATE_S)
        joints = context.store.status.robot.joints_rad
        if joints is None or estimate.sigma_translation_mm is None or estimate.enough:
            return estimate
        flange = np.array([view.base_from_flange for view in seen])
        text = await context.workers.call(next_best_text, config, flange, joints, timeout_s=_ESTIMATE_S)
        return msgspec.structs.replace(estimate, advice=text or estimate.advice)


async def look_back(context: SessionContext) -> None:
    """Reads what the images from before a restart show, for the estimate and the next pose.

    Read from the recording, which is made whole first; nothing when it is known already.
    """
    recording, queue = context.recording, context.queue
    if recording is None or recording.recorder is not None or context.seen or queue is None or not queue.done:
        return
    try:
        await context.recover_segments(recording)
        found = await context.workers.call(
            seen_before, recording.whole, context.cell.config.board, timeout_s=_LOOK_BACK_S
        )
    except (RecordingError, WorkerError) as error:
        context.store.problem(error, said="the estimate restarts, without the images so far: {}")
        return
    context.seen.update({view.index: view for view in found})
