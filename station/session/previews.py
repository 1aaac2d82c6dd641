"""Images beside the recording: previews for screens, and looks at a tag between sessions."""

from __future__ import annotations

import asyncio
import time

import numpy as np

from calibrate.boards.detect import detect
from calibrate.boards.model import check_board
from recordings.images import viewable
from recordings.schema.messages import BoardSpec, Image
from station.analysis.pool import WorkerError
from station.analysis.worker import BoardDetection, preview_image, sight
from station.cell.config import matrix4
from station.cell.errors import RefusedError, StationError
from station.cell.layout import flange_pose
from station.cell.status import NO_IMAGE, DetectionStatus, StationState
from station.cell.stillness import NotStillError
from station.protocol.verbs import Observation, Observe, PreviewImage
from station.session.capture import at_exposure
from station.session.context import SessionContext

PREVIEW_PERIOD_S = 0.1
SIDES = (16, 1024)
OLD_S = 2.0
"""Age of the newest image from which screens are told that none comes; one lost frame is no news."""
_OBSERVE_S = 5.0
_TAKING = (StationState.SETTLING, StationState.CAPTURING, StationState.WRITING)


class Previewer:
    """Preview images, never recorded, at most one per `PREVIEW_PERIOD_S` for all screens together."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._taking = asyncio.Lock()
        self._picture: Image | None = None
        self._sighting: BoardDetection | None = None
        self._taken_s = self._seen_s = 0.0
        self._count = 0

    async def look(self) -> tuple[Image, BoardDetection] | None:
        """Return image and detection of the newest preview; None without one."""
        async with self._taking:
            if time.monotonic() - self._taken_s >= PREVIEW_PERIOD_S:
                await asyncio.shield(self._take())  # for all screens, also where the one that asked closes
        if self._picture is None or self._sighting is None:
            return None
        return self._picture, self._sighting

    async def preview(self, width: int, height: int) -> PreviewImage:
        """Return a JPEG that fits into width × height, px; empty without an image."""
        await self.look()
        if self._picture is None:
            return PreviewImage()
        low, high = SIDES
        width, height = min(max(width, low), high), min(max(height, low), high)
        corners = np.zeros((0, 2)) if self._sighting is None else self._sighting.pixels
        return await asyncio.to_thread(preview_image, self._picture, corners, width, height, self._count)

    async def observe(self, tag: BoardSpec) -> Observation:
        """Find the tag's corners in a new image, with the arm's pose at mid-exposure.

        Raises BoardError, RefusedError when a session runs, NotStillError when the arm moves; CameraError,
        RobotError, WorkerError.
        """
        check_board(tag)
        context, arm = self._context, self._context.cell.arm
        async with self._taking:  # one at a time, so that a new session waits for one image at most
            _require_between_sessions(context)
            await context.ready_state()
            if not context.stillness.at_rest:
                raise NotStillError("arm-moves")
            image = await context.cell.camera.capture(_OBSERVE_S)
            state, _ = await at_exposure(context, image)
            _require_between_sessions(context)
            found = await context.workers.call(
                detect, viewable(image.pixels, image.pixel_format), tag, False, False, timeout_s=_OBSERVE_S
            )
        return Observation(
            base_from_flange=matrix4(flange_pose(state, arm.identity.tcp_offset)),
            corners=tuple(found.indices.tolist()),
            pixels=tuple((float(u), float(v)) for u, v in found.pixels),
        )

    async def _take(self) -> None:
        context = self._context
        self._taken_s = time.monotonic()
        if context.store.state in _TAKING or context.workers.waiting:
            return  # camera or worker are needed by the capture
        try:
            image = await context.cell.camera.glimpse()
        except StationError as error:
            if self._taken_s - self._seen_s > OLD_S:
                context.store.update(detection=DetectionStatus(reason=f"no image: {error}", cause=NO_IMAGE))
            return
        self._seen_s = self._taken_s
        config = context.cell.config
        try:
            exposure = (image.exposure_us, image.gain_db) if image.exposure_us else None
            pixels = viewable(image.pixels, image.pixel_format)
            sighting = await context.workers.call(
                sight, pixels, config.board, config.camera.model, False, exposure, timeout_s=5.0
            )
        except WorkerError:
            sighting = None
        self._picture, self._sighting = image, sighting
        self._count += 1
        if sighting is not None and context.store.state not in _TAKING:
            context.store.update(detection=sighting.status)


def _require_between_sessions(context: SessionContext) -> None:
    Observe.require(context.store.state)
    if context.cell.source == "playback":
        raise RefusedError("played")
