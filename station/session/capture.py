"""One stop of the arm: rest, picture, robot pose of the same moment, disk. It counts only after the disk."""

from __future__ import annotations

import asyncio
import contextlib
import time

import msgspec
import numpy as np

from calibrate.geometry import Array, inverse, pose_from_rotvec
from recordings.schema.messages import Image, RobotState, Stamps, Stillness, Vector6, View
from station.analysis.pool import WorkerError
from station.analysis.worker import BoardDetection, sight
from station.cell.config import matrix4
from station.cell.errors import CameraError, StaleStateError, StationError
from station.cell.status import PoseState, StationState
from station.devices.frames import mid_exposure
from station.session.context import CapturedView, SessionContext
from station.session.patience import RestingCheck
from station.session.picture_watch import PictureWatch
from station.session.recording import to_the_end

STATE_WAIT_S = 1.0
"""The robot state of mid-exposure may come later than the picture, on a busy computer by this much."""
SIGHT_TIMEOUT_S = 20.0
SATURATED_LIMIT = 0.05


class PoseFailedError(StationError):
    """This pose gave nothing usable; the message says why. The session goes on."""


async def take_pose(context: SessionContext, index: int, attempt: int) -> None:
    """At rest → picture → disk; marks the pose done.

    PoseFailedError and NotStillError when this pose gave nothing; RobotError and RecordingError end the run.
    """
    _phase(context, index, StationState.SETTLING, "settling")
    resting = RestingCheck(context.cell.robot.check)
    async with PictureWatch(context, index) as watch:
        still = await context.stillness.settle(resting, watch.look)
    _phase(context, index, StationState.CAPTURING, "capturing")
    picture = context.require_recording().number(await take_picture(context, index))
    show_frame(context, picture)
    device_ns, arrival_ns = picture.stamps.device_ns, picture.stamps.host_monotonic_ns
    clock = context.cell.camera.clock
    mid_ns, camera_bound_s = mid_exposure(device_ns, arrival_ns, picture.exposure_us, clock)
    state = await _state_at(context, mid_ns)
    await resting.news()
    context.stillness.require_rest(state)
    view = _view(context, index, attempt, picture, state, still, camera_bound_s)
    _require_bound(context, view)
    _phase(context, index, StationState.WRITING, "writing")
    await to_the_end(_write(context, index, picture, view))


def _phase(context: SessionContext, index: int, state: StationState, pose_state: PoseState) -> None:
    context.require_queue().mark(index, pose_state)
    context.store.enter(state)
    context.show_poses(index)


async def take_picture(context: SessionContext, index: int | None = None) -> Image:
    """Of a pose, or of none. PoseFailedError once the configured retries are used up."""
    tries = 1 + context.cell.config.capture.retries
    camera = context.cell.camera
    for number in range(1, tries + 1):
        try:
            if number == tries > 1:  # the last try, with a camera that was opened anew
                await camera.close()
                await camera.open()
            if number > 1:  # some cameras lose the first frame after a pause, and waiting for it was one
                with contextlib.suppress(CameraError):
                    await camera.glimpse()
            return await camera.capture()
        except CameraError as error:
            last = error
            context.store.event(f"picture {number} of at most {tries}: {error}", "warning", index)
    raise PoseFailedError(f"no good picture in {tries} tries: {last}")


def show_frame(context: SessionContext, picture: Image) -> None:
    height, width = picture.pixels.shape[:2]
    shown = msgspec.structs.replace(
        context.store.status.camera,
        connected=True,
        frames=picture.sequence + 1,
        width=width,
        height=height,
        exposure_us=picture.exposure_us,
        gain_db=picture.gain_db,
    )
    context.store.update(camera=shown)


async def _state_at(context: SessionContext, host_monotonic_ns: int) -> RobotState:
    deadline_s = time.monotonic() + STATE_WAIT_S
    while True:
        try:
            return context.cell.robot.at(host_monotonic_ns)
        except StaleStateError:
            if time.monotonic() > deadline_s:
                raise
            await asyncio.sleep(0.01)


def flange_pose(state: RobotState, tcp_offset: Vector6) -> Array:
    """base_from_flange (4, 4): the controller's own tool pose without the tool."""
    base_from_tcp = pose_from_rotvec(state.tcp_pose[:3], state.tcp_pose[3:])
    return np.asarray(base_from_tcp @ inverse(pose_from_rotvec(tcp_offset[:3], tcp_offset[3:])))


def _view(
    context: SessionContext,
    index: int,
    attempt: int,
    picture: Image,
    state: RobotState,
    still: Stillness,
    camera_bound_s: float,
) -> View:
    robot_clock = context.cell.robot.clock()
    bound_s = camera_bound_s + (robot_clock.bound_s if robot_clock else 0.0)
    exposure_ns = state.stamps.host_monotonic_ns
    return View(
        index=index,
        name=context.require_queue().pose(index).name,
        picture_sequence=picture.sequence,
        base_from_flange=matrix4(flange_pose(state, context.cell.robot.identity.tcp_offset)),
        joints_rad=state.joints_rad,
        attempt=attempt,
        stamps=Stamps(
            host_monotonic_ns=exposure_ns,
            host_wall_ns=state.stamps.host_wall_ns,
            controller_s=state.stamps.controller_s,
            device_ns=picture.stamps.device_ns + round(picture.exposure_us * 500),
        ),
        time_bound_s=bound_s,
        stillness=still,
    )


def _require_bound(context: SessionContext, view: View) -> None:
    limit_s = context.cell.config.capture.time_bound_s
    if view.time_bound_s is not None and view.time_bound_s > limit_s:
        raise PoseFailedError(
            f"the picture's time is known to ±{1000 * view.time_bound_s:.1f} ms only, the limit is "
            f"{1000 * limit_s:.1f} ms (capture.time_bound_s): look at the load of this computer"
        )


async def _write(context: SessionContext, index: int, picture: Image, view: View) -> None:
    """Disk and detection side by side; the view is written, and the pose counted, only with a board in it."""
    recording, queue = context.require_recording(), context.require_queue()
    recording.picture(picture)
    sighting = await _sighting(context, picture, index)
    reason = _unusable(sighting) if sighting is not None else ""
    if sighting is not None and len(sighting.pixels):
        recording.corners(picture.sequence, sighting.pixels)
    if reason:
        await recording.sync()
        raise PoseFailedError(reason)
    recording.view(view)
    await recording.sync()
    if sighting is not None:
        queue.note(index, corners=sighting.status.corners, coverage=sighting.status.coverage)
        context.store.update(detection=sighting.status)
        context.seen[index] = CapturedView(
            index, np.array(view.base_from_flange), sighting.indices, sighting.pixels
        )
    queue.mark(index, "done")
    await recording.save_state(queue)
    context.show_poses(index)
    corners = f", {sighting.status.corners} corners" if sighting is not None else ""
    context.store.event(f"saved{corners}", pose_index=index)


async def _sighting(context: SessionContext, picture: Image, index: int) -> BoardDetection | None:
    """None when the worker could not say: the data are kept, the offline stage looks again."""
    config = context.cell.config
    try:
        return await context.workers.call(
            sight, picture.pixels, config.board, config.camera.model, timeout_s=SIGHT_TIMEOUT_S
        )
    except WorkerError as error:
        context.store.event(f"the picture was not looked at: {error}", "warning", index)
        return None


def _unusable(sighting: BoardDetection) -> str:
    """Why a picture does not count; empty when it does."""
    status = sighting.status
    if not status.found:
        return status.reason or "no board in the picture"
    if status.saturated > SATURATED_LIMIT:
        return f"over-exposed: {100 * status.saturated:.0f} % of the board's pixels are white; expose less"
    return ""
