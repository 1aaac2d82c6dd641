"""Capture at one pose: settle, image, robot pose at the same time, write. Counts once it is on the disk."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from functools import partial

import numpy as np

from calibrate.views.view_set import BoardView
from recordings.geometry import base_from_flange
from recordings.images import Pixels, viewable
from recordings.schema.messages import Image, RobotState, View
from station.analysis.pool import WorkerError
from station.analysis.worker import Sighting, board_box, detection_status, image_motion, sight
from station.cell.config import matrix4
from station.cell.errors import CameraError, StaleStateError, StationError
from station.cell.status import StationState
from station.devices.base import look_at
from station.devices.news import RESTING_S
from station.session.context import SessionContext
from station.session.recording import to_the_end

SATURATED_LIMIT = 0.05
TRIES = 3
GAPS_S = (0.0, 0.0, 0.03)
"""Pauses before the images for motion; unequal between them, so that no vibration's period fits both."""
WORKER_TIMEOUT_S, DETECT_TIMEOUT_S = 5.0, 20.0

log = logging.getLogger(__name__)


class PoseFailedError(StationError):
    """Capture at a pose failed; the session goes on."""

    code = "pose-failed"


async def take_pose(context: SessionContext, index: int, attempt: int, unchecked: bool = True) -> None:
    """Wait until the arm is settled, take the image, write it, and mark the pose done.

    `unchecked`: an image counts, too, in which the worker failed to look for the board: solving looks again.

    PoseFailedError and NotStillError when the pose failed; RobotError and RecordingError end the run, and
    RefusedError where arm or camera are not those the session began with.
    """
    _enter(context, index, StationState.SETTLING)
    async with ImageWatch(context, index) as watch:
        still = await context.stillness.settle(partial(look_at, context.cell.arm, checked=True), watch.look)
    _enter(context, index, StationState.CAPTURING)
    image = context.require_recording().number(await take_image(context, index))
    state, bound_s = await at_exposure(context, image)
    context.require_same_cell()  # a device may have been exchanged while it was away
    view = View(
        index=index,
        name=context.loaded().pose(index).name,
        picture_sequence=image.sequence,
        base_from_flange=matrix4(base_from_flange(state.tcp_pose, context.cell.arm.identity.tcp_offset)),
        joints_rad=state.joints_rad or None,
        attempt=attempt,
        stamps=state.stamps,
        time_bound_s=bound_s,
        stillness=still,
    )
    _enter(context, index, StationState.WRITING)
    await to_the_end(_write(context, index, image, view, unchecked))


def _enter(context: SessionContext, index: int, state: StationState) -> None:
    context.store.enter(state)
    context.show_poses(index)


async def take_image(context: SessionContext, index: int | None = None) -> Image:
    """Take an image, for pose `index` or none. PoseFailedError after `TRIES`."""
    camera = context.cell.camera
    for number in range(1, TRIES + 1):
        try:
            if number == TRIES:  # before the last try open the camera again
                await camera.close()
                await camera.open()
            if number > 1:  # some cameras lose the first frame after a pause, such as the time-out just now
                with contextlib.suppress(CameraError):
                    await camera.glimpse()
            return await camera.capture()
        except CameraError as error:
            last = error
            context.store.problem(error, "warning", index, f"image {number} of at most {TRIES}: {{}}")
    raise PoseFailedError("no-good-image", tries=TRIES, reason=str(last))


async def at_exposure(context: SessionContext, image: Image) -> tuple[RobotState, float]:
    """Return the state of the arm, at rest, at mid-exposure, and the bound of that time, seconds.

    PoseFailedError when the time is not known well enough, NotStillError when the arm moved, RobotError.
    """
    if image.time is None:
        raise PoseFailedError("no-time")
    arm, deadline_s = context.cell.arm, time.monotonic() + RESTING_S
    while True:
        try:
            state = arm.at(image.time.host_monotonic_ns)
            break
        except StaleStateError:
            if time.monotonic() > deadline_s:
                raise
            await asyncio.sleep(0.01)
    await context.ready_state()
    context.stillness.require_rest(state)
    clock = arm.clock()
    bound_s = image.time.bound_s + (clock.bound_s if clock else 0.0)
    if bound_s > (limit_s := context.cell.config.capture.time_bound_s):
        no_clock = image.time.source == "arrival"
        advice = "Its clock cannot be read: raise the limit" if no_clock else "Reduce this computer's load"
        raise PoseFailedError("time-unsure", bound_s=bound_s, limit_s=limit_s, advice=advice)
    return state, bound_s


async def _write(context: SessionContext, index: int, image: Image, view: View, unchecked: bool) -> None:
    """Write the image while the board is detected; write the view, and count the pose, only with a board."""
    recording, queue = context.require_recording(), context.loaded()
    recording.require_open().image(image)
    sighting = await _sighting(context, image, index)
    unusable = _unusable(sighting, unchecked)
    if sighting is not None and len(sighting.detection.corners):
        recording.require_open().corners(image.sequence, sighting.detection.corners.pixels)
    if unusable is not None:
        await recording.sync()
        raise unusable
    recording.require_open().view(view)
    await recording.sync()
    if sighting is not None:
        queue.note(index, corners=len(sighting.detection.corners))
        context.store.show_detection(detection_status(sighting))
        flange = np.array(view.base_from_flange)
        context.seen.pop(index, None)  # the newest comes last
        joints = None if view.joints_rad is None else np.array(view.joints_rad)
        context.seen[index] = BoardView(index, view.name, flange, sighting.detection.corners, joints)
    queue.mark(index, "done")
    await recording.save_state(queue)
    context.show_poses(index)
    corners = len(sighting.detection.corners) if sighting is not None else None
    text = "saved" if corners is None else f"saved, {corners} corners"
    context.store.event("saved", text, "info", index, corners=corners)


async def _sighting(context: SessionContext, image: Image, index: int) -> Sighting | None:
    """Detect the board; None when the worker failed."""
    config, pixels = context.cell.config, viewable(image.pixels, image.pixel_format)
    try:
        return await context.workers.call(
            sight,
            pixels,
            config.board,
            config.camera.model,
            camera_name=config.camera.name,
            timeout_s=DETECT_TIMEOUT_S,
        )
    except WorkerError as error:
        context.store.problem(error, "warning", index, "the image was not checked: {}")
        return None


def _unusable(sighting: Sighting | None, unchecked: bool) -> PoseFailedError | None:
    """Make the error where an image does not count; None when it does."""
    if sighting is None:
        return None if unchecked else PoseFailedError("not-checked")
    status = detection_status(sighting)
    if not status.found:
        return PoseFailedError("no-board", reason=status.reason or "No board in the image.", advice="")
    if status.saturated > SATURATED_LIMIT:
        return PoseFailedError("over-exposed", saturated=status.saturated, limit=SATURATED_LIMIT)
    return None


class ImageWatch:
    """Measures image motion between three images while the arm settles, again as long as something moves.

    Runs within a `with` block; `look` is for `StillnessMonitor.settle`. Not measured if the camera fails.
    """

    def __init__(self, context: SessionContext, index: int) -> None:
        self._context, self._index = context, index
        self._found: tuple[int, float] | None = None
        """Time before which none of the three exposures began (host monotonic ns), and the motion, px."""
        self._blind = self._ended = False
        self._again = asyncio.Event()
        model = context.cell.config.camera.model
        self._width = model.width if model is not None else 0
        view = context.loaded().pose(index).view
        # A fixed camera may see mostly background at rest, so look at the board, which may swing.
        fixed = context.cell.config.mount == "eye-to-hand" and model is not None
        self._box = board_box(view, model.width, model.height) if fixed and model is not None else None

    def look(self, since_ns: int) -> float | None:
        """Return the motion (px) in images exposed after a host time; NaN: not measurable, None: not yet."""
        if self._blind:
            return math.nan
        self._again.set()
        if self._found is None or self._found[0] < since_ns:
            return None
        return self._found[1]

    async def __aenter__(self) -> ImageWatch:
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *_: object) -> None:
        """End the measurement; a request to the camera that is under way is completed first."""
        self._ended = True
        self._again.set()
        await asyncio.wait({self._task})

    async def _run(self) -> None:
        try:
            while not self._ended and (motion := await self._measure()) is not None:
                self._found = motion
                self._again.clear()
                if not self._ended:
                    await self._again.wait()
        except Exception as error:  # even a defect must not block the pose
            if not isinstance(error, StationError):
                log.exception("the image motion could not be measured")
            if not self._ended:  # if it persists, the next image reports it
                self._context.store.problem(error, "warning", self._index, "image motion not measured: {}")
        self._blind = True

    async def _measure(self) -> tuple[int, float] | None:
        """Return the time before three images, and the motion in them; None: nobody waits any more."""
        begun_ns, images = time.monotonic_ns(), list[Pixels]()
        for gap_s in GAPS_S:
            await asyncio.sleep(gap_s)
            try:
                image = await self._context.cell.camera.glimpse()
            except CameraError:  # one lost frame is no reason to look no more
                if self._ended:
                    return None
                image = await self._context.cell.camera.glimpse()
            if self._ended:
                return None
            images.append(viewable(image.pixels, image.pixel_format))
        motion_px = await self._context.workers.call(
            image_motion, images, self._width, self._box, timeout_s=WORKER_TIMEOUT_S
        )
        return begun_ns, math.nan if motion_px is None else motion_px
