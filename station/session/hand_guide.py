"""Guidance in freedrive: what would help most, how still everything is; views are taken by themselves."""

from __future__ import annotations

import asyncio
import logging
import time

import numpy as np

from recordings.errors import CodedError
from recordings.schema.messages import CameraModel
from station.analysis.estimation import FEWEST_FOR_LENS
from station.analysis.guidance import NextView, Way, motion_px, next_view, way_to
from station.analysis.worker import CapturedView
from station.cell.errors import RobotError
from station.cell.status import FEWEST_BY_HAND, GuidanceStatus, StationState
from station.session.context import SessionContext
from station.session.freedrive import FreedriveCapture
from station.session.previews import PREVIEW_PERIOD_S, Previewer

GIVE_UP_S = 5.0
"""Rest at a place that is not new after which another view is asked for."""
_CHOOSE_S = 20.0

log = logging.getLogger(__name__)


class HandGuide:
    """Task that guides a person in freedrive. It never moves the arm; `take_pose` judges what it takes."""

    def __init__(self, context: SessionContext, previews: Previewer, freedrive: FreedriveCapture) -> None:
        self._context, self._previews, self._freedrive = context, previews, freedrive
        self._wanted: NextView | None = None
        self._known: tuple[int, ...] | None = None
        """Numbers of the views by which it was chosen."""
        self._given_up = list[np.ndarray]()
        self._number, self._pixels = -1, np.zeros((0, 2))
        """Number of the last preview, and the corners in it."""
        self._motion_px: float | None = None
        """Motion of the board between the last two previews; None: it was not seen in both."""
        self._moved_s, self._failed = 0.0, False
        """When something moved last; whether an image failed or was taken back since: no other is tried."""
        self._taken = 0
        """Number of views at the last look."""

    async def run(self) -> None:
        store = self._context.store
        while True:
            await asyncio.sleep(PREVIEW_PERIOD_S)
            if store.state is not StationState.FREE_DRIVE or self._freedrive.taking:
                if store.state in (StationState.IDLE, StationState.PAUSED):
                    store.update(guidance=GuidanceStatus())
                    self._known, self._failed, self._taken = None, False, 0
                    self._given_up.clear()
                continue
            try:
                await self._guide()
            except CodedError as error:  # a lost image, a late state: the next look may see more
                log.debug("no guidance: %s", error)
            except Exception:  # capture by hand goes on without it
                log.exception("the guidance failed")

    async def _guide(self) -> None:
        context, store = self._context, self._context.store
        looked, recording = await self._previews.look(), context.recording
        if looked is None or recording is None or recording.camera is None:
            return
        number, image, seen = looked
        self._failed |= len(context.seen) < self._taken  # one was taken back: none again from here
        self._taken = len(context.seen)
        wanted, way = await self._next(recording.camera), Way("", False)
        # With fewer the lens is rough, and its error would pass for one of board or mounting.
        cell = wanted.found if len(wanted.seen) >= FEWEST_FOR_LENS else None
        if seen.status.found:
            scale = wanted.camera.width / image.pixels.shape[1]
            view = CapturedView(-1, np.eye(4), seen.indices, (seen.pixels + 0.5) * scale - 0.5)
            way = await context.workers.call(way_to, wanted, view, timeout_s=_CHOOSE_S)
        if number != self._number:
            before, self._pixels = self._pixels, seen.pixels
            self._number, self._motion_px = number, motion_px(before, seen.pixels)
        found, moves, still = context.stillness.measure(self._motion_px), "too few robot states", 0.0
        try:
            context.cell.robot.latest()
        except RobotError as error:  # what was measured is not of now
            found, moves = None, str(error)
        if found is not None:
            moves, still = context.stillness.unrest(found), context.stillness.rest(found)
        if (found is not None and moves) or self._motion_px is None:
            self._moved_s, self._failed = time.monotonic(), False
        if store.state is not StationState.FREE_DRIVE:
            return
        store.update(
            guidance=GuidanceStatus(
                outline=wanted.drawn,
                words=way.words,
                still=round(still, 2),
                moves=moves,
                new=way.new,
                after_mm=None if wanted.after_m is None else round(1000 * wanted.after_m, 3),
                cause="" if cell is None else cell.cause,
                warning="" if cell is None else cell.warning,
                enough=len(context.seen) >= FEWEST_BY_HAND and store.status.estimate.enough,
            )
        )
        if moves or self._motion_px is None or seen.status.cause == "blurred" or self._failed:
            return
        if way.new:
            self._failed = await self._freedrive.record(asked=False) not in context.seen
            self._taken += not self._failed  # it may be taken back before the next look
        elif seen.status.found and time.monotonic() - self._moved_s > GIVE_UP_S:
            self._given_up.append(wanted.camera_from_board)
            self._known, self._moved_s = None, time.monotonic()

    async def _next(self, recorded: CameraModel) -> NextView:
        """Choose the wanted view anew when the views have changed."""
        context, config = self._context, self._context.cell.config
        if self._wanted is None or tuple(context.seen) != self._known:
            if self._known is not None:
                self._given_up.clear()
            known = tuple(context.seen)
            self._wanted = await context.workers.call(
                next_view,
                config.mount,
                config.board,
                config.camera.model or recorded,
                context.cell.camera_model is not None,
                list(context.seen.values()),
                list(self._given_up),
                timeout_s=_CHOOSE_S,
            )
            self._known = known
        return self._wanted
