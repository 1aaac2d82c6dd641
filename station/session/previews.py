"""Images beside the recording: previews for screens, and looks at a tag between sessions."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import NamedTuple

import msgspec
import numpy as np

from calibrate.boards.detect import detect
from calibrate.boards.model import check_board
from recordings.geometry import base_from_flange
from recordings.images import viewable
from recordings.schema.messages import BoardSpec, Image
from station.analysis.pool import WorkerError
from station.analysis.worker import Sighting, detection_status, preview_image, sight, smaller_image
from station.cell.config import matrix4
from station.cell.errors import RefusedError, StationError
from station.cell.status import NO_IMAGE, NOT_LOOKED, OLD_S, DetectionStatus, StationState
from station.cell.stillness import NotStillError
from station.protocol.states import RUNNING
from station.protocol.verbs import Observation, Observe, PreviewImage
from station.session.capture import at_exposure
from station.session.context import SessionContext

PREVIEW_PERIOD_S = 0.1
SIDES = (16, 1024)
LOOK_S = 0.5
"""Longest wait for the board to be found in an image before the image is shown without it; a search that
takes longer is slow, and the next images are made smaller."""
QUICK_S = 0.05
"""Longest search in a smaller image after which images are searched as they come again."""
BUSY = "the computer is busy: a smaller picture is looked at"
PATIENCE_S = 30.0
PATIENCE_IN_A_RUN_S = 15.0
"""Longest time that looking for the board may take, on a busy computer, before the worker counts as hanging.
In a run the capture waits behind it."""
NO_IMAGE_S = 5.0
"""Time for which it is told that no image came: longer than until the next try."""
_OBSERVE_S = 5.0
_TAKING = (StationState.SETTLING, StationState.CAPTURING, StationState.WRITING)


class Looked(NamedTuple):
    """An image, and the board in it."""

    image: Image
    taken_s: float
    """When the image came (host monotonic)."""
    sighting: Sighting | None
    """None: the worker hung or died."""
    took_s: float


class Previewer:
    """Preview images, never recorded, at most one per `PREVIEW_PERIOD_S` for all screens together."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._taking = asyncio.Lock()
        self._picture: Image | None = None
        """The newest image."""
        self._sighting: Sighting | None = None
        """The board in it; None: it was not looked for, or not in time."""
        self._taken_s = 0.0
        """When an image was last asked for (host monotonic); 0: never."""
        self._seen_s = 0.0
        """When the newest image came."""
        self._looked_s = 0.0
        """When the newest image came in which the board was looked for."""
        self._slow = False
        """Searches take long: images are made smaller."""
        self._looking: asyncio.Task[Looked] | None = None
        """The search for the board in an image, which may take longer than the next image does."""
        self._count = 0

    async def look(self) -> tuple[Image, Sighting] | None:
        """Return an image and the board in it, however long that takes; None without one."""
        await self._renew()
        if self._picture is not None and self._sighting is not None and self._age_s <= OLD_S:
            return self._picture, self._sighting
        if self._looking is None:
            return None
        looked = await asyncio.shield(self._looking)
        return None if looked.sighting is None else (looked.image, looked.sighting)

    async def preview(self, width: int, height: int) -> PreviewImage:
        """Return a JPEG that fits into width × height, px; empty without an image."""
        await self._renew()
        if self._picture is None:
            return PreviewImage()
        low, high = SIDES
        width, height = min(max(width, low), high), min(max(height, low), high)
        age_s = self._age_s
        corners = np.zeros((0, 2))
        if self._sighting is not None and age_s <= OLD_S:
            corners = self._sighting.detection.corners.pixels
        made = await asyncio.to_thread(preview_image, self._picture, corners, width, height, self._count)
        return msgspec.structs.replace(made, age_s=round(age_s, 2))

    @property
    def _age_s(self) -> float:
        """Age of the newest image, and of the board in it."""
        return time.monotonic() - self._seen_s

    async def _renew(self) -> None:
        async with self._taking:
            if time.monotonic() - self._taken_s >= PREVIEW_PERIOD_S:
                await asyncio.shield(self._take())  # for all screens, also where the one that asked closes

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
            base_from_flange=matrix4(base_from_flange(state.tcp_pose, arm.identity.tcp_offset)),
            corners=tuple(found.corners.ids.tolist()),
            pixels=tuple((float(u), float(v)) for u, v in found.corners.pixels),
        )

    async def _take(self) -> None:
        """Take an image, and look for the board in it.

        Where that takes long the image is shown without its board, and the next ones, too, until it is done.
        """
        context = self._context
        self._taken_s = time.monotonic()
        if context.store.state in _TAKING:
            return  # the capture needs the camera
        try:
            image = await context.cell.camera.glimpse()
        except StationError as error:
            if self._taken_s - self._seen_s > OLD_S:
                missing = DetectionStatus(reason=f"no image: {error}", cause=NO_IMAGE)
                context.store.show_detection(missing, NO_IMAGE_S)
            return
        if self._slow:
            image = await asyncio.to_thread(smaller_image, image, SIDES[1])
        self._seen_s = self._taken_s
        self._picture = image
        self._sighting = await self._sighted(image)
        if self._seen_s - self._looked_s > OLD_S:
            reason = "not looked at for the board: the computer is busy"
            self._tell(DetectionStatus(reason=reason, cause=NOT_LOOKED), NO_IMAGE_S)
        self._count += 1

    async def _sighted(self, image: Image) -> Sighting | None:
        """Look for the board in the newest image, for `LOOK_S`, and tell the screens what is seen.

        None: it takes longer, or the worker is at other work, such as a plan or the search in an earlier
        image. Then the image is shown without its board.
        """
        if self._looking is None:
            if self._context.workers.waiting:
                return None
            self._looking = asyncio.create_task(self._look_in_worker(image, self._seen_s))
            await asyncio.wait({self._looking}, timeout=LOOK_S)
        if not self._looking.done():
            return None
        looked = self._looking.result()
        self._looking = None
        self._slow = looked.took_s > (QUICK_S if self._slow else LOOK_S)
        if looked.sighting is None:
            return None
        self._looked_s = looked.taken_s
        status = detection_status(looked.sighting)
        if self._slow and not status.advice:
            status = msgspec.structs.replace(status, advice=BUSY)
        self._tell(status, looked.taken_s + OLD_S - time.monotonic())
        return looked.sighting if looked.image is image else None

    def _tell(self, detection: DetectionStatus, lasts_s: float) -> None:
        """Tell the screens, for so long; in a capture they are told of its own image."""
        if self._context.store.state not in _TAKING and lasts_s > 0:
            self._context.store.show_detection(detection, lasts_s)

    async def _look_in_worker(self, image: Image, taken_s: float) -> Looked:
        """Look for the board in the worker."""
        context = self._context
        config = context.cell.config
        exposure = (image.exposure_us, image.gain_db) if image.exposure_us else None
        patience_s = PATIENCE_IN_A_RUN_S if context.store.state in RUNNING else PATIENCE_S
        began_s = time.monotonic()
        sighting = None
        with contextlib.suppress(WorkerError):
            sighting = await context.workers.call(
                sight,
                viewable(image.pixels, image.pixel_format),
                config.board,
                config.camera.model,
                False,
                exposure,
                config.camera.name,
                timeout_s=patience_s,
            )
        return Looked(image, taken_s, sighting, time.monotonic() - began_s)


def _require_between_sessions(context: SessionContext) -> None:
    Observe.require(context.store.state)
    if context.cell.source == "playback":
        raise RefusedError("played")
