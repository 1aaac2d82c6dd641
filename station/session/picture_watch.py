"""Watches the picture while the arm comes to rest: three pictures, their motion, and again while it moves."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from types import TracebackType
from typing import Any

from numpy.typing import NDArray

from recordings.schema.messages import Image
from station.analysis.picture_motion import board_box, picture_motion
from station.cell.errors import CameraError, StationError
from station.cell.stillness import ImageMotion
from station.session.context import SessionContext

log = logging.getLogger(__name__)

GAPS_S = (0.0, 0.03)
"""Uneven, so that a ringing whose period fits one gap does not fit the other."""
PICTURES = 3
GLIMPSE_TRIES = 2
WORKER_TIMEOUT_S = 5.0


class PictureWatch:
    """For the time of a `with` block; `look` is for `StillnessMonitor.settle`.

    A camera that cannot be looked at (played pictures), or fails to, leaves the motion unmeasured.
    """

    def __init__(self, context: SessionContext, index: int) -> None:
        self._context, self._index = context, index
        self._pictures: deque[tuple[int, NDArray[Any]]] = deque(maxlen=PICTURES)
        self._found: tuple[int, ImageMotion] | None = None
        """With the time before which none of its pictures began."""
        self._blind = False
        self._again = asyncio.Event()
        self._glimpsing: asyncio.Task[Image | None] | None = None
        self._task: asyncio.Task[None] | None = None
        model = context.cell.config.camera.model
        self._width = model.width if model is not None else 0
        view = context.require_queue().pose(index).view
        # A fixed camera may see more of a resting background than of the board that swings before it.
        fixed = context.cell.config.mount == "eye-to-hand" and model is not None
        self._box = board_box(view, model.width, model.height) if fixed and model is not None else None

    def look(self, since_ns: int) -> ImageMotion | None:
        """Of pictures that were exposed after this host time; None: not yet, ask again."""
        if self._blind:
            return ImageMotion(None)
        self._again.set()
        if self._found is None or self._found[0] < since_ns:
            return None
        return self._found[1]

    async def __aenter__(self) -> PictureWatch:
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """The camera is free again when this returns: a request to it is never given up half-way."""
        assert self._task is not None
        self._task.cancel()
        ending = {self._task, *([self._glimpsing] if self._glimpsing else [])}
        await asyncio.wait(ending)
        # Nobody waits for this look any more: its failure is the next picture's to tell.
        await asyncio.gather(*ending, return_exceptions=True)

    async def _run(self) -> None:
        try:
            while await self._one_more():
                if len(self._pictures) == PICTURES:
                    await self._measure()
                    self._again.clear()
                    await self._again.wait()
                else:
                    await asyncio.sleep(GAPS_S[len(self._pictures) - 1])
        except Exception as error:  # a defect, too, must not keep the pose waiting
            if not isinstance(error, StationError):
                log.exception("the picture's motion could not be measured")
            self._context.store.event(
                f"the picture's motion is not measured: {error}", "warning", self._index
            )
        self._blind = True

    async def _one_more(self) -> bool:
        """False when this camera has none to show."""
        for left in reversed(range(GLIMPSE_TRIES)):
            asked_ns = time.monotonic_ns()
            self._glimpsing = asyncio.create_task(self._context.cell.camera.glimpse())
            try:
                picture = await asyncio.shield(self._glimpsing)
            except CameraError:
                if not left:
                    raise
                continue
            if picture is not None:
                self._pictures.append((asked_ns, picture.pixels))
            return picture is not None
        return False

    async def _measure(self) -> None:
        images = [image for _, image in self._pictures]
        motion_px = await self._context.workers.call(
            picture_motion, images, self._width, self._box, timeout_s=WORKER_TIMEOUT_S
        )
        self._found = (self._pictures[0][0], ImageMotion(motion_px))
