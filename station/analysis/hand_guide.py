"""The guide of a person who moves the arm: which view next, the way there, rest, and when to take it.

Sessions by hand and the wizard of a new cell both follow it. It moves nothing and takes nothing.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import numpy as np

from calibrate.views.view_set import BoardView
from recordings.geometry import Array
from recordings.schema.messages import BoardSpec, CameraModel, Image, Mount, RobotIdentity
from station.analysis.estimation import FEWEST_FOR_LENS
from station.analysis.guidance import NextView, Way, motion_px, next_view, way_to
from station.analysis.worker import Sighting
from station.cell.errors import RobotError
from station.cell.status import GuidanceStatus
from station.cell.stillness import StillnessMonitor

GIVE_UP_S = 5.0
"""Rest at a place that is not new after which another view is asked for; and after an image that failed
before it is tried again: lateness passes, and a person who sees everything rest would wait for ever."""
_CHOOSE_S = 20.0
R = TypeVar("R")


class Call(Protocol):
    """Runs a function elsewhere, so that the event loop does not wait for it."""

    async def __call__(self, function: Callable[..., R], *args: object, timeout_s: float) -> R: ...


async def in_thread(function: Callable[..., R], *args: object, timeout_s: float) -> R:
    """The call where there is no worker process."""
    return await asyncio.to_thread(function, *args)


class HandGuide:
    """One for each beginning: a session by hand, a cell's views.

    `latest`: the arm's newest state, RobotError where there is none. `stillness` is fed by its states.
    `robot`: the arm, for the error that the next view is to leave.
    """

    def __init__(
        self,
        latest: Callable[[], object],
        stillness: StillnessMonitor,
        robot: RobotIdentity,
        call: Call = in_thread,
    ) -> None:
        self._latest, self._stillness, self._call = latest, stillness, call
        self._robot = robot
        self.way = Way("", False)
        """From the newest image to the wanted view."""
        self.take = False
        """Everything rests before a new view that was not tried: it is to be taken."""
        self._wanted: NextView | None = None
        self._known: tuple[object, ...] | None = None
        """The cell and the numbers of the views by which it was chosen."""
        self._given_up = list[Array]()
        self._seen: Sighting | None = None
        self._motion_px: float | None = None
        """Motion of the board between the last two images; None: it was not seen in both."""
        self._moved_s = self._again_s = 0.0
        """When something moved last; from when on an image is tried, where one failed or was taken back."""
        self._count = 0
        """Number of views at the last look."""

    def taken(self, kept: bool) -> None:
        """Tell what came of the view that was to be taken."""
        self._again_s = 0.0 if kept else time.monotonic() + GIVE_UP_S
        self._count += kept  # it may be taken back before the next look

    async def look(
        self,
        cell: tuple[Mount, BoardSpec, CameraModel, bool],
        views: Sequence[BoardView],
        image: Image,
        seen: Sighting,
    ) -> GuidanceStatus:
        """Compare the newest image with the wanted view, and set `way` and `take`.

        `cell`: as `next_view` takes it. `views`: those that count; `seen`: the board in `image`.
        """
        self.take = False
        if len(views) < self._count:  # one was taken back: none again from here
            self._again_s = float("inf")
        self._count = len(views)
        wanted, way = await self._next(cell, views), Way("", False)
        if seen.detection.found:
            scale = wanted.camera.width / image.pixels.shape[1]  # previews may be smaller
            view = BoardView(-1, "now", np.eye(4), seen.detection.corners.scaled(scale))
            way = await self._call(way_to, wanted, view, timeout_s=_CHOOSE_S)
        self.way = way
        if seen is not self._seen:
            before, self._seen = self._seen, seen
            self._motion_px = None
            if before is not None:
                self._motion_px = motion_px(before.detection.corners, seen.detection.corners)
        found, moves = self._stillness.measure(self._motion_px), ""
        try:
            self._latest()
        except RobotError as error:  # what was measured is not of now
            found, moves = None, str(error)
        moves = moves or self._stillness.unrest(found)
        if (found is not None and moves) or self._motion_px is None:
            self._moved_s, self._again_s = time.monotonic(), 0.0
        tried = time.monotonic() < self._again_s
        if not moves and self._motion_px is not None and seen.cause != "blurred" and not tried:
            self.take = way.new
            if not way.new and seen.detection.found and time.monotonic() - self._moved_s > GIVE_UP_S:
                self._given_up.append(wanted.camera_from_board)
                self._known, self._moved_s = None, time.monotonic()
        # With fewer the lens is rough, and its error would pass for one of board or mounting.
        judged = wanted.found if len(wanted.seen) >= FEWEST_FOR_LENS else None
        problem = None if judged is None else judged.problem
        return GuidanceStatus(
            outline=wanted.drawn,
            words=way.words,
            still=0.0 if found is None else round(self._stillness.rest(found), 2),
            moves=moves,
            after_mm=None if wanted.after_m is None else round(1000 * wanted.after_m, 3),
            cause="" if problem is None else problem.code,
            warning=str(problem or ""),
        )

    async def _next(
        self, cell: tuple[Mount, BoardSpec, CameraModel, bool], views: Sequence[BoardView]
    ) -> NextView:
        """Choose the wanted view anew when cell or views have changed."""
        known = (*cell, *(view.index for view in views))
        if self._wanted is None or known != self._known:
            if self._known is not None:
                self._given_up.clear()
            self._wanted = await self._call(
                next_view, *cell, list(views), list(self._given_up), self._robot, timeout_s=_CHOOSE_S
            )
            self._known = known
        return self._wanted
