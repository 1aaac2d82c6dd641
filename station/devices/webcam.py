"""Webcams and other cameras of the operating system, through `cv2.VideoCapture`.

They have no trigger and no clock: images come free-running, and their exposure time is known only from their
arrival, to ±0.1 s.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from recordings.schema.messages import CameraIdentity, Image, Stamps
from station.cell.config import CameraConfig
from station.cell.errors import CameraError
from station.cell.status import CameraCounts, FrameTiming
from station.devices.base import DeviceThread
from station.devices.discovery import kernel_text
from station.devices.frames import by_arrival

T = TypeVar("T")
LATENCY_S = 0.2
"""Longest time from exposure to arrival (readout, compression, USB, driver); assumed, not measured."""
_GLIMPSE_S = 1.0
_OPEN_S = 20.0
_PATIENCE_S = 0.5
_EXPOSURE_UNIT_US = 100.0
"""Unit of V4L2's absolute exposure"""
_MANUAL_EXPOSURE = 1
_FOUND_AT_S = 1.0
"""Largest age of a driver's stamp that is taken as of the monotonic clock."""
_SYSTEM = Path("/sys/class/video4linux")


class WebcamCamera:
    """Webcam behind `devices.base.Camera`; `config.device` is a number or a path."""

    def __init__(self, config: CameraConfig) -> None:
        self._config = config
        self._video: cv2.VideoCapture | None = None
        self._worker = DeviceThread("webcam")
        self._fixed: dict[str, float] = {}
        """Exposure and focus at opening; only those that the camera has"""
        self._frames = self._missing = 0
        self.identity = CameraIdentity(driver="webcam")

    @property
    def timing(self) -> FrameTiming | None:
        return FrameTiming("arrival", LATENCY_S / 2) if self._video is not None else None

    def counts(self) -> CameraCounts:
        return CameraCounts(frames=self._frames, missing=self._missing)

    async def open(self) -> CameraIdentity:
        await self._run(self._open, _OPEN_S)
        return self.identity

    async def capture(self, timeout_s: float = 5.0) -> Image:
        """Return a frame whose exposure began after this call; takes `LATENCY_S` longer than a frame."""
        timeout_s += self._exposure_us() / 1e6
        try:
            return await self._run(partial(self._fresh, timeout_s), timeout_s)
        except CameraError:
            self._missing += 1
            raise

    async def settings(self) -> dict[str, object]:
        return await self._run(self._settings, _GLIMPSE_S)

    async def glimpse(self) -> Image:
        return await self.capture(_GLIMPSE_S)

    async def close(self) -> None:
        await self._worker.close(self._release)

    async def _run(self, job: Callable[[], T], timeout_s: float) -> T:
        """Run a job in the driver's thread; CameraError when it does not end in time."""
        running = self._worker.run(job)
        done, _ = await asyncio.wait({running}, timeout=timeout_s + _PATIENCE_S)
        if not done:
            running.cancel()
            raise CameraError("no-image", limit_s=timeout_s)
        return running.result()

    def _open(self) -> None:
        self._release()
        device = self._config.device or "0"
        # The daemon retries and reports failures itself.
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        video = cv2.VideoCapture(int(device) if device.isdecimal() else device)
        if not video.isOpened():
            raise CameraError("no-webcam", device=device)
        found = _identity(device)
        if self.identity.serial not in ("", found.serial):
            before, now = (f"{camera.model} {camera.serial}" for camera in (self.identity, found))
            raise CameraError("other-webcam", device=device, now=now, before=before)
        self._video, self.identity = video, found
        try:
            self._set_up(video)
        except CameraError:
            self._release()
            raise

    def _set_up(self, video: cv2.VideoCapture) -> None:
        config, wanted = self._config, _wanted_size(self._config)
        if wanted is not None:
            video.set(cv2.CAP_PROP_FRAME_WIDTH, wanted[0])
            video.set(cv2.CAP_PROP_FRAME_HEIGHT, wanted[1])
        video.set(cv2.CAP_PROP_AUTOFOCUS, 0)
        if "focus" in self._fixed:  # opened again: the focus must be that of the images before
            video.set(cv2.CAP_PROP_FOCUS, self._fixed["focus"])
        if video.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE):
            video.set(cv2.CAP_PROP_EXPOSURE, config.exposure_us / _EXPOSURE_UNIT_US)
        if video.get(cv2.CAP_PROP_AUTOFOCUS) > 0:
            raise CameraError("autofocus")
        size = round(video.get(cv2.CAP_PROP_FRAME_WIDTH)), round(video.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if wanted not in (None, size):
            raise CameraError("webcam-size", given=f"{size[0]}×{size[1]}", wanted=str(wanted))
        self._fixed = _readable(video)

    def _release(self) -> None:
        video, self._video = self._video, None
        if video is not None:
            video.release()

    def _live(self) -> cv2.VideoCapture:
        """Return the open device; after it was lost, open it again."""
        if self._video is None:
            if not self.identity.serial:
                raise CameraError("not-open")
            self._open()
        assert self._video is not None
        return self._video

    def _settings(self) -> dict[str, object]:
        video = self._live()
        width, height = video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        return {
            "pixel_format": "Mono8" if self._config.pixel_format.startswith("Mono") else "BGR8",
            "region": [0, 0, round(width), round(height)],
            "frame_rate_hz": video.get(cv2.CAP_PROP_FPS),
            **_readable(video),
        }

    def _fresh(self, timeout_s: float) -> Image:
        """Return the first frame that was certainly exposed after now, discarding queued ones."""
        asked_ns, video = time.monotonic_ns(), self._live()
        self._check(video)
        while time.monotonic_ns() < asked_ns + timeout_s * 1e9:
            arrived_ns = self._grab(video)
            begun_ns = arrived_ns - round(self._exposure_us() * 1000) - round(LATENCY_S * 1e9)
            if begun_ns >= asked_ns:
                return self._image(video, arrived_ns, begun_ns)
        raise CameraError("no-image", limit_s=timeout_s)

    def _check(self, video: cv2.VideoCapture) -> None:
        now = _readable(video)
        if now != self._fixed:
            raise CameraError("settings-changed", found=str(now), wanted=str(self._fixed))

    def _grab(self, video: cv2.VideoCapture) -> int:
        """Grab the next frame; return its arrival (host monotonic ns), by its stamp if there is one."""
        if not video.grab():
            self._release()
            raise CameraError("camera-gone", camera=self._config.device)
        now_ns = time.monotonic_ns()
        stamp_ns = round(video.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        return stamp_ns if 0 <= now_ns - stamp_ns < _FOUND_AT_S * 1e9 else now_ns

    def _image(self, video: cv2.VideoCapture, arrived_ns: int, begun_ns: int) -> Image:
        """`begun_ns`: when its exposure began at the earliest, host monotonic."""
        good, pixels = video.retrieve()
        if not good:
            raise CameraError("frame-incomplete", reason="it cannot be decoded")
        self._frames += 1
        if grey := self._config.pixel_format.startswith("Mono"):
            pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY) if pixels.ndim == 3 else pixels
        age_ns = time.monotonic_ns() - arrived_ns
        exposure_us = self._exposure_us()
        return Image(
            pixels=np.ascontiguousarray(pixels),
            stamps=Stamps(host_monotonic_ns=arrived_ns, host_wall_ns=time.time_ns() - age_ns),
            frame_id=None,
            sequence=0,
            exposure_us=exposure_us,
            pixel_format="Mono8" if grey else "BGR8",
            time=by_arrival(arrived_ns, exposure_us, begun_ns),
        )

    def _exposure_us(self) -> float:
        """Read the exposure (µs); 0 where the camera does not tell."""
        return self._fixed.get("exposure_us", 0.0)


def _wanted_size(config: CameraConfig) -> tuple[int, int] | None:
    """Return the configured width and height; CameraError for a region that is not at the origin."""
    if config.region is None:
        return (config.model.width, config.model.height) if config.model is not None else None
    x, y, width, height = config.region
    if (x, y) != (0, 0):
        raise CameraError("webcam-region", x=x, y=y)
    return width, height


def _readable(video: cv2.VideoCapture) -> dict[str, float]:
    """Read exposure (µs) and focus (camera's unit), where it has them: OpenCV returns -1 or 0 for none.

    An automatic exposure (V4L2's modes 0, 2 and 3) is as none: it may differ in the next frame.
    """
    known = {
        "exposure_us": video.get(cv2.CAP_PROP_EXPOSURE) * _EXPOSURE_UNIT_US,
        "focus": video.get(cv2.CAP_PROP_FOCUS),
    }
    automatic = video.get(cv2.CAP_PROP_AUTO_EXPOSURE) not in (-1, _MANUAL_EXPOSURE)
    return {name: value for name, value in known.items() if value > 0 and not (automatic and name != "focus")}


def discover_webcams(system: Path = _SYSTEM) -> list[tuple[str, str]]:
    """List device file and name of each camera of the kernel, without its further nodes for metadata."""
    nodes = sorted(system.glob("video*"), key=lambda node: int(node.name.removeprefix("video")))
    return [
        (f"/dev/{node.name}", kernel_text(node / "name") or node.name)
        for node in nodes
        if kernel_text(node / "index") in ("", "0")
    ]


def _identity(device: str) -> CameraIdentity:
    """Make the identity from the kernel's data; without a serial number, from the path."""
    node = f"video{device}" if device.isdecimal() else Path(device).resolve().name
    return CameraIdentity(
        vendor=kernel_text(_SYSTEM / node / "device/../manufacturer"),
        model=kernel_text(_SYSTEM / node / "name") or "webcam",
        serial=kernel_text(_SYSTEM / node / "device/../serial") or node,
        driver="webcam",
    )
