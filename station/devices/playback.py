"""Plays images as a camera, and a recording as camera and robot together.

Nothing played is ever taken for real: its driver is `playback`, and so is the source of what is recorded.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, cast

import cv2
import msgspec
import numpy as np

from calibrate.geometry import interpolate, pose_from_rotvec
from recordings import strict_yaml
from recordings.errors import RecordingError
from recordings.images import Pixels
from recordings.reader import Recording, open_recording
from recordings.schema.clocks import ClockFit
from recordings.schema.messages import (
    CameraIdentity,
    FrameTime,
    Image,
    RobotIdentity,
    RobotState,
    Stamps,
    Vector6,
    View,
)
from station.cell.acceptance import StopWay
from station.cell.config import CameraConfig, StationConfig, vector6
from station.cell.errors import CameraError, ConfigError, RobotError, StaleStateError
from station.cell.plan import Plan, PlannedPose
from station.cell.scene import pose_vector
from station.devices.cell import Cell
from station.devices.frames import CameraCounts, FrameTiming

STATE_RATE_HZ = 100.0
MOVE_S = 0.2
"""Every move takes this long, whatever the recorded one took."""
_SAME_JOINTS_RAD = 0.02
_STAMP_BOUND_S = 1e-6
_HOST_CLOCK = ClockFit(
    reference_s=0.0,
    offset_ns=0.0,
    drift=0.0,
    residual_s=0.0,
    drift_uncertainty=0.0,
    latency_s=_STAMP_BOUND_S,
    samples=1,
    span_s=0.0,
)
"""Played images are stamped by the host's own clock."""
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
VIDEO_SUFFIXES = (".avi", ".mp4", ".mkv", ".mov", ".mpg", ".mpeg")
FOLDER_RATE_HZ = 10.0
"""A folder's own pace: its files say nothing of time."""
CONFIG_NAME = "config.yaml"


class Played(NamedTuple):
    picture: Image
    at_s: float
    """When it was taken, counted from the first."""


class PlayedSource(NamedTuple):
    name: str
    identity: CameraIdentity
    frames: Iterator[Played]
    """In order; raises CameraError at an image that cannot be read."""


def open_source(path: Path) -> PlayedSource:
    """Raises CameraError with the remedy."""
    if not path.exists():
        raise CameraError(
            f"nothing to play at {path}",
            code="nothing-to-play",
            remedy="Name a folder, a video or a recording in camera.device.",
        )
    if path.is_dir() and not any(path.glob("*.mcap")):
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES)
        if not files:
            raise CameraError(f"no images in {path} ({', '.join(PICTURE_SUFFIXES)})", code="nothing-to-play")
        return PlayedSource(path.name, _identity("folder", path), _folder(files))
    if path.suffix.lower() in VIDEO_SUFFIXES:
        capture = cv2.VideoCapture(str(path))
        if not capture.isOpened():
            raise CameraError(f"{path} is not a video that OpenCV can read", code="unreadable-video")
        return PlayedSource(path.name, _identity("video", path), _video(path, capture))
    return _recording(path)


def _identity(kind: str, path: Path) -> CameraIdentity:
    return CameraIdentity(vendor="playback", model=kind, serial=path.name, driver="playback")


def _folder(files: list[Path]) -> Iterator[Played]:
    for number, file in enumerate(files):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise CameraError(
                f"{file} is not an image that OpenCV can read",
                code="unreadable-image",
                remedy="Repair or remove it.",
            )
        if image.ndim == 3 and image.shape[2] == 4:
            image = cv2.cvtColor(image, cv2.COLOR_BGRA2BGR)
        wide = "Mono16" if image.dtype.itemsize == 2 else "Mono8"
        pixel_format = "BGR8" if image.ndim == 3 else wide
        pixels = cast(Pixels, image)
        yield Played(Image(pixels, Stamps(), 0, number, pixel_format=pixel_format), number / FOLDER_RATE_HZ)


def _video(path: Path, capture: cv2.VideoCapture) -> Iterator[Played]:
    rate_hz = capture.get(cv2.CAP_PROP_FPS) or FOLDER_RATE_HZ
    number = 0
    try:
        while True:
            good, image = capture.read()
            if not good:
                break
            pixels = np.asarray(image, np.uint8)
            yield Played(Image(pixels, Stamps(), 0, number, pixel_format="BGR8"), number / rate_hz)
            number += 1
    finally:
        capture.release()
    if number == 0:
        raise CameraError(f"{path} has no readable frame", code="unreadable-video")


def _recording(path: Path) -> PlayedSource:
    try:
        recording = open_recording(path)
        info = recording.info
    except RecordingError as error:
        raise CameraError(f"{path} cannot be played: {error}", code="unreadable-recording") from error

    def frames() -> Iterator[Played]:
        first_ns: int | None = None
        try:
            for _, picture in recording.images():
                taken_ns = picture.stamps.host_monotonic_ns
                first_ns = taken_ns if first_ns is None else first_ns
                yield Played(picture, max(0.0, (taken_ns - first_ns) / 1e9))
        except RecordingError as error:
            raise CameraError(
                f"{path} cannot be played further: {error}", code="unreadable-recording"
            ) from error

    camera = info.camera_identity
    identity = CameraIdentity(camera.vendor, camera.model, camera.serial, "playback")
    return PlayedSource(info.name, identity, frames())


class PlaybackCamera:
    """`station.devices.base.Camera` over `config.device`; with a robot, it shows what that robot looks at.

    `config.playback_pace`: 0 = as fast as asked, 1 = at its own pace, 2 = twice as fast.
    """

    def __init__(self, config: CameraConfig, robot: PlaybackRobot | None = None) -> None:
        self._config = config
        self._robot = robot
        self._source: PlayedSource | None = None
        self._newest: Image | None = None
        self._frame_id = 0
        self._taken = 0
        self._start_s: float | None = None
        self._busy = asyncio.Lock()
        self.identity = CameraIdentity(driver="playback")
        self.timing = FrameTiming("latched", _STAMP_BOUND_S, _HOST_CLOCK)

    def counts(self) -> CameraCounts:
        return CameraCounts(frames=self._taken)

    async def open(self) -> CameraIdentity:
        self._source = await asyncio.to_thread(open_source, Path(self._config.device))
        self.identity = self._source.identity
        self._start_s = None
        return self.identity

    async def capture(self, timeout_s: float = 5.0) -> Image:
        """The next image; CameraError at the end, or when it is not due within `timeout_s`."""
        async with self._busy:
            if self._source is None:
                raise CameraError("nothing is being played", code="not-open", remedy="Open the camera first.")
            if self._robot is not None:
                picture = await asyncio.to_thread(self._robot.picture)
            else:
                played = await asyncio.to_thread(next, self._source.frames, None)
                if played is None:
                    raise CameraError(
                        f"'{self._source.name}' is at its end after {self._taken} images",
                        code="played-out",
                        remedy="Open it again.",
                        images=self._taken,
                    )
                await self._wait_for(played, timeout_s)
                picture = played.picture
            self._frame_id += 1
            now_ns = time.monotonic_ns()
            self._newest = msgspec.structs.replace(
                picture,
                stamps=Stamps(host_monotonic_ns=now_ns, host_wall_ns=time.time_ns(), device_ns=now_ns),
                frame_id=self._frame_id,
                sequence=self._taken,
                time=FrameTime(now_ns, _STAMP_BOUND_S, "latched"),
            )
            self._taken += 1
            return self._newest

    async def settings(self) -> dict[str, object]:
        return {"device": self._config.device, "pace": self._config.playback_pace}

    async def glimpse(self) -> Image | None:
        """None: a played image was taken once, how it moved then cannot be seen in it."""
        return None

    async def preview(self) -> Image | None:
        """The newest image; with a robot, what it looks at now."""
        if self._robot is not None and self._source is not None:
            try:
                return await asyncio.to_thread(self._robot.picture)
            except CameraError:
                return None
        return self._newest

    async def close(self) -> None:
        self._source = None

    async def _wait_for(self, played: Played, timeout_s: float) -> None:
        if self._config.playback_pace <= 0:
            return
        now_s = time.monotonic()
        self._start_s = now_s if self._start_s is None else self._start_s
        left_s = self._start_s + played.at_s / self._config.playback_pace - now_s
        if left_s > timeout_s:
            await asyncio.sleep(timeout_s)
            raise CameraError(
                f"the next image was taken {left_s:.0f} s later",
                code="no-image",
                remedy="Raise camera.playback_pace.",
                left_s=left_s,
                limit_s=timeout_s,
            )
        await asyncio.sleep(max(0.0, left_s))


class PlaybackRobot:
    """`station.devices.base.Robot` that stands where the recorded arm stood.

    It can move only to joints that the recording has an image from.
    """

    def __init__(self, recording: Path) -> None:
        """Raises RobotError for a recording that cannot be read or has no joints."""
        try:
            self._recording: Recording = open_recording(recording)
            self.views: list[View] = self._recording.views()
        except RecordingError as error:
            raise RobotError(f"{recording} cannot be played: {error}", code="unreadable-recording") from error
        if not self.views or any(v.joints_rad is None for v in self.views):
            raise RobotError(
                f"{recording} has no joints for every view: it plays as a camera only", code="no-joints"
            )
        self._lock = threading.Lock()
        self._from = self._to = self.views[0]
        self._move_start_s = -MOVE_S
        self._halted_at: float | None = None
        self._callbacks: list[Callable[[RobotState], None]] = []
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self.control = False
        self.identity = self._recording.info.robot
        self.control_path, self.notice, self.remote, self.kinematics = "", "", None, None
        self.payload: tuple[float, ...] = ()

    def plan(self) -> Plan:
        """The recorded poses as a plan."""
        poses = tuple(
            PlannedPose(v.name, _joints(v), v.base_from_flange, why="of the recording") for v in self.views
        )
        return Plan(self.identity.model, self._recording.info.mount, poses, note="playback")

    def picture(self) -> Image:
        """Image of the view the arm stands at; CameraError between two, or when it cannot be decoded."""
        view, moving = self._standing()
        if moving:
            raise CameraError("playback has images only from where the recorded arm stood", code="no-image")
        try:
            return self._recording.image(view)
        except RecordingError as error:
            raise CameraError(error.text, code=error.code, remedy=error.remedy, **error.values) from error

    async def connect(self) -> RobotIdentity:
        if self._thread is None:
            self._thread = threading.Thread(target=self._publish, name="playback robot", daemon=True)
            self._thread.start()
        return self.identity

    def subscribe(self, callback: Callable[[RobotState], None]) -> None:
        self._callbacks.append(callback)

    def latest(self) -> RobotState:
        return self.at(time.monotonic_ns())

    def at(self, host_monotonic_ns: int) -> RobotState:
        age_s = (time.monotonic_ns() - host_monotonic_ns) / 1e9
        if not -0.01 <= age_s <= 10.0:
            raise StaleStateError(f"no played state {age_s:.1f} s ago", age_s=age_s)
        with self._lock:
            before, after, fraction = self._from, self._to, self._fraction(host_monotonic_ns / 1e9)
        a, b = np.array(before.joints_rad), np.array(after.joints_rad)
        flange = interpolate(np.array(before.base_from_flange), np.array(after.base_from_flange), fraction)
        speed = (b - a) / MOVE_S if 0 < fraction < 1 and self._halted_at is None else np.zeros(6)
        tool = flange @ pose_from_rotvec(self.identity.tcp_offset[:3], self.identity.tcp_offset[3:])
        return RobotState(
            stamps=Stamps(
                host_monotonic_ns=host_monotonic_ns,
                host_wall_ns=time.time_ns() - round(age_s * 1e9),
                controller_s=host_monotonic_ns / 1e9,
            ),
            joints_rad=vector6(a + fraction * (b - a)),
            joint_speeds_rad_s=vector6(speed),
            target_joints_rad=_joints(after),
            tcp_pose=pose_vector(tool),
            robot_mode=7,
            safety_mode=1,
            safety_status_bits=1,
            runtime_state=2 if self.control else 1,
            robot_status_bits=1,
            speed_scaling=1.0,
            target_speed_fraction=1.0,
        )

    def clock(self) -> ClockFit | None:
        return _HOST_CLOCK

    def check(self) -> None: ...

    async def start_control(self) -> None:
        self.control = True

    async def move(self, joints_rad: Sequence[float], speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """RobotError where the recording was never at these joints."""
        target = np.asarray(joints_rad, dtype=float)
        off = [float(np.abs(np.array(v.joints_rad) - target).max()) for v in self.views]
        nearest = int(np.argmin(off))
        if not self.control:
            raise RobotError("playback cannot move: motion is not approved", code="no-control")
        if off[nearest] > _SAME_JOINTS_RAD:
            raise RobotError("playback moves only to where the recorded arm stood", code="not-recorded")
        with self._lock:
            self._from, self._to, self._halted_at = self._to, self.views[nearest], None
            self._move_start_s = time.monotonic()
        await asyncio.sleep(MOVE_S)

    def heartbeat(self) -> None: ...

    def stop_one_way(self, way: StopWay) -> None:
        raise RobotError("a played-back arm has no ways to stop", code="playback")

    async def stop(self, reason: str) -> None:
        with self._lock:
            if self._fraction(time.monotonic()) < 1 and self._halted_at is None:
                self._halted_at = self._fraction(time.monotonic())
        self.control = False

    async def end_control(self) -> None:
        self.control = False

    async def close(self) -> None:
        self._ending.set()
        if self._thread is not None:
            await asyncio.to_thread(self._thread.join)

    def _standing(self) -> tuple[View, bool]:
        with self._lock:
            return self._to, self._fraction(time.monotonic()) < 1

    def _fraction(self, at_s: float) -> float:
        """Share of the current move, 0 … 1."""
        if self._halted_at is not None:
            return self._halted_at
        return float(np.clip((at_s - self._move_start_s) / MOVE_S, 0.0, 1.0))

    def _publish(self) -> None:
        while not self._ending.wait(1 / STATE_RATE_HZ):
            state = self.latest()
            for callback in self._callbacks:
                callback(state)


def _joints(view: View) -> Vector6:
    assert view.joints_rad is not None
    return view.joints_rad


def playback_cell(recording: Path) -> Cell:
    """Everything is marked as playback; its plan is the recorded poses.

    RobotError or ConfigError for a recording that is damaged, has no joints or no configuration in it.
    """
    robot = PlaybackRobot(recording)
    try:
        content = open_recording(recording).attachments().get(CONFIG_NAME, b"")
        recorded = strict_yaml.load(content, StationConfig)
    except (RecordingError, strict_yaml.StrictYamlError) as error:
        raise ConfigError(
            f"{recording} holds no usable {CONFIG_NAME} of a station ({error}): it cannot be replayed",
            code="no-config",
            remedy="`calibrate solve` and Foxglove need none.",
        ) from error
    camera = msgspec.structs.replace(
        recorded.camera, driver="playback", device=str(recording), trigger="software", playback_pace=0.0
    )
    config = msgspec.structs.replace(
        recorded,
        name="playback",
        camera=camera,
        trigger=None,
        robot=msgspec.structs.replace(recorded.robot, host="", serial=""),
    )
    return Cell(
        config=config,
        robot=robot,
        camera=PlaybackCamera(camera, robot),
        source="playback",
        plan=robot.plan(),
    )
