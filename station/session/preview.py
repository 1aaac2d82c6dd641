"""Images for the screen: small, shared by all watchers, looked at outside the loop, never recorded."""

from __future__ import annotations

import asyncio
import base64
import time

import cv2
import numpy as np

from recordings.images import eight_bits
from recordings.schema.messages import Image
from station.analysis.pool import WorkerError
from station.analysis.worker import BoardDetection, sight
from station.cell.errors import CameraError
from station.cell.status import StationState
from station.protocol.verbs import PreviewImage
from station.session.context import SessionContext

PERIOD_S = 0.2
JPEG_LIMIT_BYTES = 40_000
"""In base64 it must fit into one line of the protocol."""
_QUALITIES = (75, 50, 30, 15)
SIDES = (16, 1024)


class Previewer:
    """Asks the camera at most once per `PERIOD_S`, however many screens watch."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._taking = asyncio.Lock()
        self._picture: Image | None = None
        self._sighting: BoardDetection | None = None
        self._taken_s = 0.0
        self._count = 0

    async def preview(self, width: int, height: int) -> PreviewImage:
        """A JPEG that fits into width × height, px; empty without an image."""
        async with self._taking:
            if time.monotonic() - self._taken_s >= PERIOD_S:
                await self._take()
        if self._picture is None:
            return PreviewImage()
        low, high = SIDES
        width, height = min(max(width, low), high), min(max(height, low), high)
        return await asyncio.to_thread(self._encode, self._picture, self._sighting, width, height)

    async def _take(self) -> None:
        context = self._context
        self._taken_s = time.monotonic()
        if context.store.state is StationState.CAPTURING or context.workers.waiting:
            return  # the capture has the camera, or the worker is needed for more than the screen
        try:
            image = await context.cell.camera.preview()
        except CameraError:
            image = None
        if image is None:
            return
        config = context.cell.config
        try:
            exposure = (image.exposure_us, image.gain_db) if image.exposure_us else None
            sighting = await context.workers.call(
                sight, image.viewable(), config.board, config.camera.model, False, exposure, timeout_s=5.0
            )
        except WorkerError:
            sighting = None
        self._picture, self._sighting = image, sighting
        self._count += 1
        if sighting is not None and context.store.state is not StationState.WRITING:
            context.store.update(detection=sighting.status)

    def _encode(self, taken: Image, sighting: BoardDetection | None, width: int, height: int) -> PreviewImage:
        image = eight_bits(taken.viewable(), taken.pixel_format)
        scale = min(width / image.shape[1], height / image.shape[0], 1.0)
        size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        for quality in _QUALITIES:
            ok, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])
            if ok and len(jpeg) <= JPEG_LIMIT_BYTES:
                sides = image.shape[1::-1]
                pixels = np.zeros((0, 2)) if sighting is None else (sighting.pixels + 0.5) / sides
                corners = tuple((float(x), float(y)) for x, y in pixels.round(4))
                data = base64.b64encode(jpeg.tobytes()).decode()
                return PreviewImage(data, *size, corners, self._count)
        return PreviewImage()
