"""Running estimate: camera and board pose by the images so far."""

from __future__ import annotations

import asyncio
import contextlib
import logging

from calibrate.views.view_set import BoardView
from recordings.errors import RecordingError
from station.analysis.estimation import running_estimate, seen_before
from station.analysis.found_cell import odd_view
from station.analysis.pool import WorkerError
from station.cell.status import EstimateStatus
from station.session.context import SessionContext
from station.session.recording import stamps_now
from station.session.threads import DISK

_LOOK_BACK_S, _ESTIMATE_S = 120.0, 20.0
"""Longest the worker may take: for all images from before a restart, and for one estimate."""

log = logging.getLogger(__name__)


class Estimator:
    """Task that updates the running estimate in the worker after each pose, one at a time."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._known: tuple[BoardView, ...] = ()
        self._woken = asyncio.Event()

    def poke(self) -> None:
        """Request an update; cheap."""
        if tuple(self._context.seen.values()) != self._known:  # also where a pose was captured again
            self._woken.set()

    async def run(self) -> None:
        context, config = self._context, self._context.cell.config
        while True:
            await self._woken.wait()
            self._woken.clear()
            self._known = seen = tuple(context.seen.values())
            if not seen:
                context.store.update(estimate=EstimateStatus())
                continue
            recorded = None if context.recording is None else context.recording.camera
            if (camera := config.camera.model or recorded) is None:
                continue
            queue, known, odd = context.queue, context.cell.camera_model is not None, None
            try:
                estimate = await context.workers.call(
                    running_estimate, config, camera, known, seen, timeout_s=_ESTIMATE_S
                )
                if context.cell.mover is None:  # poses typed or posted may be wrong: look for one
                    odd = await context.workers.call(
                        odd_view, config.mount, config.board, camera, known, seen, timeout_s=_ESTIMATE_S
                    )
            except Exception as error:  # the capture does not depend on it, so it must not end
                if not isinstance(error, WorkerError):
                    log.exception("the running estimate failed")
                context.store.problem(error, said="the placed-point error is not updated: {}")
                continue
            context.store.update(estimate=estimate)
            if odd is not None:
                context.store.problem(odd, "warning", seen[-1].index)
            if queue is not None and queue is context.queue:
                queue.note(seen[-1].index, estimated_sigma_mm=estimate.predicted_error_mm)
                context.store.update_session(poses=queue.statuses)
            if (recording := context.recording) is not None:
                with contextlib.suppress(RecordingError):  # a full disk is reported by the run
                    recording.show_frames(estimate.camera_pose, estimate.board_pose, stamps_now())


async def look_back(context: SessionContext) -> None:
    """Detect the board in the images from before a restart, for the running estimate.

    They are read from the recording, recovered first. Does nothing when they are known already.
    """
    recording, queue = context.recording, context.queue
    if recording is None or recording.recorder is not None or context.seen or queue is None or not queue.done:
        return
    try:
        await context.recover_segments(recording)
        found = await context.workers.call(
            seen_before, await DISK.run(recording.whole), context.cell.config.board, timeout_s=_LOOK_BACK_S
        )
    except (RecordingError, WorkerError) as error:
        context.store.problem(error, said="the estimate restarts, without the images so far: {}")
        return
    context.seen.update({view.index: view for view in found})
