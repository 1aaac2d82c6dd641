"""Device status ten times a second, opening and reopening of devices, and preview images."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from calibrate.boards.detect import detect
from calibrate.boards.model import check_board
from recordings.images import viewable
from recordings.schema.clocks import ClockFit
from recordings.schema.messages import BoardSpec, Image, RobotState
from station.analysis.pool import WorkerError
from station.analysis.worker import BoardDetection, preview_image, sight
from station.cell.config import SPEED_CAP_M_S, matrix4
from station.cell.errors import CameraError, RefusedError, RobotError, StationError
from station.cell.layout import flange_pose
from station.cell.limits import point_speed_m_s
from station.cell.session_folder import CALIBRATION_FILE
from station.cell.status import (
    CameraStatus,
    ClockStatus,
    RecorderStatus,
    RobotStatus,
    StationState,
    TriggerStatus,
)
from station.cell.stillness import NotStillError
from station.protocol.states import RUNNING
from station.protocol.verbs import Observation, Observe, PreviewImage
from station.session.capture import at_exposure
from station.session.context import SessionContext
from station.session.threads import WATCH

log = logging.getLogger(__name__)

RETRY_S = 3.0
DISK_PERIOD_S = 0.5
FPS_PERIOD_S = 2.0
PAUSES = "pauses after this pose"
FINISHES = "finishes after this pose"
PREVIEW_PERIOD_S = 0.2
SIDES = (16, 1024)
_OBSERVE_S = 5.0
WALL_STEP_S = 0.5
"""Smallest step of the wall clock that is reported; less may be slewing, or delay between readings."""


class Monitor:
    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._files = _Files()
        self._reading: asyncio.Task[_Files] | None = None
        self._read_s = -DISK_PERIOD_S
        self._controller: tuple[float, float] | None = None
        self._states_seen = 0
        self._frames = (0.0, 0)
        """Time and count of states at the last measurement of the rate"""
        self._wall_ahead_ns = _wall_ahead_ns()
        context.cell.robot.subscribe(self._count)

    def _count(self, state: RobotState) -> None:
        """Count a state; called in the reader's thread, so kept minimal."""
        self._states_seen += 1

    def refresh(self, lag_ms: float) -> None:
        self._watch_wall_clock()
        self._watch_files()
        store, notice = self._context.store, self._context.cell.robot.notice
        if store.state is StationState.MOVING:
            store.update(reason=notice)  # such as 'speed slider at 5 %'
        store.update(
            robot=self._robot(),
            camera=self._camera(),
            trigger=self._trigger(),
            recorder=self._recorder(),
            clock=self._clock(),
            loop_lag_ms=round(lag_ms, 1),
            pending=self._pending(),
        )

    def _pending(self) -> str:
        """Name the request (pause, finish) that waits for the end of the pose under way."""
        context = self._context
        if context.store.state not in RUNNING:
            return ""
        return FINISHES if context.requests.finish else PAUSES if context.requests.pause_by else ""

    def _watch_wall_clock(self) -> None:
        """Report when the wall clock was set: no data depend on it, but times are compared by people."""
        ahead_ns = _wall_ahead_ns()
        step_s, self._wall_ahead_ns = (ahead_ns - self._wall_ahead_ns) / 1e9, ahead_ns
        if abs(step_s) >= WALL_STEP_S:
            text = f"the wall clock was set by {step_s:+.1f} s; images and poses are placed by other clocks"
            self._context.store.event("wall-clock-set", text, "warning", step_s=round(step_s, 1))

    def _robot(self) -> RobotStatus:
        context, robot = self._context, self._context.cell.robot
        identity, config = robot.identity, context.cell.config
        limit = min(config.limits.speed_m_s, SPEED_CAP_M_S)
        base = RobotStatus(
            model=identity.model,
            serial=identity.serial,
            controller_version=identity.controller_version,
            host=config.robot.host,
            remote=robot.remote,
            control=robot.control,
            control_path=robot.control_path,
            not_accepted=self._files.not_accepted,
            speed_limit_m_s=limit,
            rate_hz=self._rate_hz(),
        )
        try:
            state = robot.latest()
        except RobotError:
            return base
        words = robot.condition(state)
        return msgspec.structs.replace(
            base,
            connected=True,
            age_ms=round((time.monotonic_ns() - state.stamps.host_monotonic_ns) / 1e6, 0),
            safety=words.safety,
            mode=words.mode,
            held=words.held,
            program=words.program,
            speed_m_s=round(point_speed_m_s(context.geometry, state.joints_rad, state.joint_speeds_rad_s), 3),
            slider=round(state.target_speed_fraction, 3),
            joints_rad=state.joints_rad,
            base_from_flange=matrix4(flange_pose(state, identity.tcp_offset)),
            still=context.stillness.at_rest,
        )

    def _rate_hz(self) -> float:
        """Compute the rate of states over the last period of at least a second."""
        now_s = time.monotonic()
        if self._controller is None or now_s - self._controller[0] >= 1.0:
            last = self._controller
            seen, self._states_seen = self._states_seen, 0
            rate = seen / (now_s - last[0]) if last is not None else 0.0
            self._controller = (now_s, round(rate))
        return self._controller[1]

    def _camera(self) -> CameraStatus:
        counts, now_s = self._context.cell.camera.counts(), time.monotonic()
        shown = self._context.store.status.camera
        fps, (then_s, frames) = shown.fps, self._frames
        if now_s - then_s >= FPS_PERIOD_S:
            fps = round((counts.frames - frames) / (now_s - then_s), 1) if then_s else 0.0
            self._frames = now_s, counts.frames
        return msgspec.structs.replace(
            shown,
            fps=fps,
            dropped=counts.missing,
            lost_packets=counts.stream.missing_packets,
            resent_packets=counts.stream.resent_packets,
        )

    def _trigger(self) -> TriggerStatus:
        shown, box = self._context.store.status.trigger, self._context.cell.trigger
        if box is None or not shown.present:
            return shown
        paired = self._context.cell.camera.counts().paired
        return msgspec.structs.replace(shown, pulses=box.pulses, frames=paired)

    def _recorder(self) -> RecorderStatus:
        free_bytes = self._files.free_bytes
        if (recorder := self._context.recorder) is None:
            return RecorderStatus(free_bytes=free_bytes)
        return RecorderStatus(
            recording=True,
            path=str(recorder.part_path),
            bytes=recorder.bytes_written,
            drops=recorder.dropped,
            sync_ms=round(1000 * recorder.last_sync_s, 1),
            free_bytes=free_bytes,
            error=str(recorder.error or ""),
        )

    def _watch_files(self) -> None:
        """Read files in a thread, as a hanging disk must not delay the heartbeat."""
        if self._reading is not None:
            if not self._reading.done():
                return
            read, self._reading = self._reading, None
            self._files = read.result()
            session = self._context.store.status.session
            solved = self._files.calibration if session.folder == self._files.session else ""
            self._context.store.update_session(calibration=solved)
        if (now_s := time.monotonic()) - self._read_s >= DISK_PERIOD_S:
            self._read_s = now_s
            session, context = self._context.store.status.session, self._context
            self._reading = asyncio.create_task(
                WATCH.run(_read_files, context, session.folder if session.recording else "")
            )

    def _clock(self) -> ClockStatus:
        robot, frames = self._context.cell.robot.clock(), self._context.cell.camera.timing
        if frames is None:
            return ClockStatus(*_clock_facts(robot))
        offset_ms, _, drift_ppm = _clock_facts(frames.clock)
        bound_ms = round(1000 * frames.bound_s, 2)
        return ClockStatus(*_clock_facts(robot), offset_ms, bound_ms, drift_ppm, frames.source)


def _wall_ahead_ns() -> int:
    return time.time_ns() - time.monotonic_ns()


@dataclass(frozen=True)
class _Files:
    """Facts of files that other programs write: free space, acceptance, calibration."""

    free_bytes: int | None = None
    not_accepted: str = ""
    session: str = ""
    """Folder of the finished session that is shown."""
    calibration: str = ""
    """Calibration file made from it by another process; empty: none yet."""


def _read_files(context: SessionContext, folder: str) -> _Files:
    path = Path(folder) / CALIBRATION_FILE
    solved = str(path) if folder and path.is_file() else ""
    trouble = context.cell.acceptance_trouble(context.root)
    return _Files(_free_bytes(context.root), trouble, folder, solved)


def _free_bytes(root: Path) -> int | None:
    """Measure free space in steps of 100 MB, the last 1 GB in steps of 1 MB; None where the disk is gone."""
    try:
        free = shutil.disk_usage(root).free
    except OSError:
        return None
    step = 100_000_000 if free >= 1_000_000_000 else 1_000_000
    return free // step * step


def _clock_facts(fit: ClockFit | None) -> tuple[float | None, float | None, float | None]:
    if fit is None:
        return None, None, None
    return round(1000 * fit.offset_s, 1), round(1000 * fit.bound_s, 2), round(fit.drift_ppm, 1)


class DeviceConnector:
    """Background task that opens all devices (read-only), with retries, and closes them at the end."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self.troubles: dict[str, str] = {}
        """Device → error of its last opening."""

    async def run(self) -> None:
        """Open all devices in parallel."""
        await asyncio.gather(
            self._start_worker(),
            self._until_open("robot", self._open_robot),
            self._until_open("camera", self._open_camera),
            self._until_open("trigger", self._open_trigger),
        )

    async def _start_worker(self) -> None:
        try:
            await self._context.workers.start()
        except WorkerError as error:
            log.warning("%s", error)

    async def _until_open(self, device: str, opening: Callable[[], Awaitable[None]]) -> None:
        while True:
            try:
                await opening()
            except Exception as error:
                if not isinstance(error, StationError):
                    log.exception("%s could not be opened", device)
                if self.troubles.get(device) != str(error):
                    self.troubles[device] = str(error)
                    self._context.store.problem(error, said=f"{device}: {{}}")
                await asyncio.sleep(RETRY_S)
            else:
                self.troubles.pop(device, None)
                return

    async def _open_robot(self) -> None:
        identity = await self._context.cell.robot.connect()
        self._found("robot", f"{identity.model} {identity.serial}")

    async def _open_camera(self) -> None:
        identity, config = await self._context.cell.camera.open(), self._context.cell.config.camera
        width, height = (config.model.width, config.model.height) if config.model else (0, 0)
        shown = CameraStatus(
            connected=True,
            model=identity.model,
            serial=identity.serial,
            driver=identity.driver,
            width=width,
            height=height,
            exposure_us=config.exposure_us,
            gain_db=config.gain_db,
        )
        self._context.store.update(camera=shown)
        self._found("camera", f"{identity.model} {identity.serial}")

    async def _open_trigger(self) -> None:
        if (trigger := self._context.cell.trigger) is not None:
            identity = await trigger.open()
            self._context.store.update(trigger=TriggerStatus(present=True, identity=identity))
            self._found("trigger", identity)

    def _found(self, device: str, identity: str) -> None:
        self._context.store.event("device-found", f"{device} {identity} found", device=device)

    async def close(self) -> None:
        """Close all devices in parallel, so that a hanging camera does not delay the robot's."""
        cell = self._context.cell

        async def close_robot() -> None:
            with contextlib.suppress(RobotError):
                await cell.robot.close()

        async def close_camera() -> None:
            with contextlib.suppress(CameraError):
                await cell.camera.close()
            if cell.trigger is not None:
                await cell.trigger.close()

        await asyncio.gather(close_robot(), close_camera())
        await asyncio.to_thread(cell.ended)


class Previewer:
    """Preview images, never recorded, at most one per `PREVIEW_PERIOD_S` for all screens together."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._taking = asyncio.Lock()
        self._picture: Image | None = None
        self._sighting: BoardDetection | None = None
        self._taken_s = 0.0
        self._count = 0

    async def preview(self, width: int, height: int) -> PreviewImage:
        """Return a JPEG that fits into width × height, px; empty without an image."""
        async with self._taking:
            if time.monotonic() - self._taken_s >= PREVIEW_PERIOD_S:
                await self._take()
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
        context, robot = self._context, self._context.cell.robot
        async with self._taking:  # one at a time, so that a new session waits for one image at most
            _require_between_sessions(context)
            await context.arm()
            if not context.stillness.at_rest:
                raise NotStillError("The arm moves.", code="arm-moves", remedy="Ask again when it rests.")
            image = await context.cell.camera.capture(_OBSERVE_S)
            state, _ = await at_exposure(context, image)
            _require_between_sessions(context)
            found = await context.workers.call(
                detect, viewable(image.pixels, image.pixel_format), tag, False, False, timeout_s=_OBSERVE_S
            )
        return Observation(
            mount=context.cell.config.mount,
            source=context.cell.source,
            robot_serial=robot.identity.serial,
            camera_serial=context.cell.camera.identity.serial,
            wall_ns=state.stamps.host_wall_ns,
            rested_s=(state.stamps.host_monotonic_ns - context.stillness.moved_ns) / 1e9,
            base_from_flange=matrix4(flange_pose(state, robot.identity.tcp_offset)),
            joints_rad=state.joints_rad,
            width=image.pixels.shape[1],
            height=image.pixels.shape[0],
            tcp_offset=robot.identity.tcp_offset,
            corners=tuple(found.indices.tolist()),
            pixels=tuple((float(u), float(v)) for u, v in found.pixels),
        )

    async def _take(self) -> None:
        context = self._context
        self._taken_s = time.monotonic()
        if context.store.state is StationState.CAPTURING or context.workers.waiting:
            return  # camera or worker are needed by the capture
        try:
            image = await context.cell.camera.preview()
        except CameraError:
            image = None
        if image is None:
            return
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
        if sighting is not None and context.store.state is not StationState.WRITING:
            context.store.update(detection=sighting.status)


def _require_between_sessions(context: SessionContext) -> None:
    if (refusal := Observe.refusal(context.store.state)) is not None:
        raise refusal
    if context.cell.source == "playback":
        raise RefusedError("Played-back images are not new.", code="played", remedy="Use `calibrate watch`.")
