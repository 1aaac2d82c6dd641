"""Placed-point errors that a plan predicts, kept true while poses are skipped, failed or taken again."""

from __future__ import annotations

import asyncio
import logging

from station.plan.planner import predicted_errors_m
from station.session.context import SessionContext
from station.session.queue import PoseQueue

_PREDICT_S = 20.0
"""Longest the worker may take."""

log = logging.getLogger(__name__)


class Predictor:
    """Task that predicts the errors again, in the worker, whenever other poses are to be taken."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._known: tuple[PoseQueue | None, tuple[int, ...]] = (None, ())
        """The poses predicted for, and those of them that are taken."""
        self._woken = asyncio.Event()

    def poke(self) -> None:
        """Request a prediction; cheap."""
        queue = self._context.queue
        if queue is not None and (queue, queue.predicted) != self._known:
            self._woken.set()

    async def run(self) -> None:
        while True:
            await self._woken.wait()
            self._woken.clear()
            if (queue := self._context.queue) is None:
                continue
            self._known = queue, queue.predicted
            errors_m = await self._errors_m(queue)
            if queue is self._context.queue and queue.predicted == self._known[1]:
                queue.predict(errors_m)
                self._context.store.update_session(poses=queue.statuses)

    async def _errors_m(self, queue: PoseQueue) -> dict[int, float]:
        """Return pose number → error after it. Empty where it is not known: the plan's own is not true."""
        context = self._context
        whole = queue.planned_errors_m
        if set(queue.predicted) >= set(whole):
            return whole
        taken = tuple(index for index in queue.predicted if index in whole)
        lens_known = context.store.status.session.check
        try:
            found = await context.workers.call(
                predicted_errors_m,
                context.cell.config,
                queue.plan,
                taken,
                lens_known=lens_known,
                timeout_s=_PREDICT_S,
            )
        except Exception as error:  # the capture does not depend on it, so it must not end
            log.warning("the placed-point error of the plan is not known: %s", error)
            return {}
        return dict(zip(taken, found, strict=True))
