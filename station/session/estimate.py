"""Keeps the running estimate fresh: one look in the worker after each pose, never two at once."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

import msgspec
import numpy as np

from recordings.schema.messages import CameraModel
from station.analysis.estimation import next_best_text, running_estimate
from station.analysis.pool import WorkerError
from station.cell.status import EstimateStatus
from station.session.context import SessionContext

log = logging.getLogger(__name__)

_TIMEOUT_S = 20.0


class Estimator:
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
                estimate = await self._estimate(camera)
            except Exception as error:  # this task looks on; it must outlive every picture and every defect
                if not isinstance(error, WorkerError):
                    log.exception("the running estimate failed")
                context.store.event(f"no running estimate: {error}", "warning")
                continue
            hint = self._hint(estimate)
            if hint and not context.store.status.estimate.improve:
                context.store.event(hint)
            context.store.update(estimate=msgspec.structs.replace(estimate, improve=hint))

    async def _estimate(self, camera: CameraModel) -> EstimateStatus:
        """With advice on the next pose, where one more would help."""
        context, config = self._context, self._context.cell.config
        seen = [(v.index, v.base_from_flange, v.indices, v.pixels) for v in context.seen.values()]
        estimate = await context.workers.call(
            running_estimate,
            config.mount,
            camera,
            context.cell.camera_model is not None,
            config.board,
            seen,
            config.capture.goal_m,
            timeout_s=_TIMEOUT_S,
        )
        joints = context.store.status.robot.joints_rad
        if joints is None or estimate.sigma_translation_mm is None or estimate.enough:
            return estimate
        flange = np.array([v[1] for v in seen])
        text = await context.workers.call(next_best_text, config, flange, joints, timeout_s=_TIMEOUT_S)
        return msgspec.structs.replace(estimate, advice=text or estimate.advice)
