"""GenICam cameras, each with its own worker thread, because calls to a lost camera block for seconds."""

from __future__ import annotations

import asyncio
import time
from functools import partial

import msgspec

from recordings.schema.messages import CameraIdentity, Image
from station.cell.config import CameraConfig
from station.cell.errors import CameraError
from station.cell.status import CameraCounts, FrameTiming
from station.devices.aravis_device import GenicamDevice
from station.devices.base import DeviceThread
from station.devices.frames import FrameClock, FrameCounter, TriggerPulse
from station.devices.serial_trigger import SerialTrigger

_CLOCK_READINGS = 8
_GLIMPSE_S = 1.0


class AravisCamera:
    """GenICam camera behind `devices.base.Camera`; with `camera.trigger: hardware` fired by `trigger`."""

    def __init__(self, config: CameraConfig, trigger: SerialTrigger | None = None) -> None:
        if config.trigger == "hardware" and trigger is None:
            raise CameraError("no-trigger")
        self._config = config
        self._trigger = trigger
        self._device: GenicamDevice | None = None
        self._worker = DeviceThread("aravis")
        self._busy = asyncio.Lock()
        self._clock = FrameClock()
        self.identity = CameraIdentity(driver="aravis")
        self.counter = FrameCounter()

    @property
    def timing(self) -> FrameTiming | None:
        return self._clock.timing

    def counts(self) -> CameraCounts:
        return self.counter.counts()

    async def open(self) -> CameraIdentity:
        async with self._busy:
            await self._worker.run(self._open)
        return self.identity

    async def settings(self) -> dict[str, object]:
        """Read the settings back from the camera."""
        async with self._busy:
            return await self._worker.run(lambda: self._live().settings())

    async def capture(self, timeout_s: float = 5.0) -> Image:
        # A trigger and its frame stay together even if the caller is cancelled, or the next gets that frame.
        return await asyncio.shield(self._one(timeout_s))

    async def glimpse(self) -> Image:
        """Take an image that is not recorded, triggered like any other, by the trigger box too."""
        return await self.capture(_GLIMPSE_S)

    async def _one(self, timeout_s: float) -> Image:
        async with self._busy:
            await self._worker.run(self._prepare)
            pulse: TriggerPulse | None = None
            asked_ns = time.monotonic_ns()
            if self._config.trigger == "hardware":
                assert self._trigger is not None
                pulse = await self._trigger.fire()
            count = None if pulse is None else pulse.count
            try:
                picture = await self._worker.run(partial(self._take, timeout_s))
            except CameraError:
                self.counter.lost(count)
                raise
            self.counter.accept(picture.frame_id, count)
            # Read after the exposure: a change during it must show, too.
            exposure_us, gain_db = await self._worker.run(lambda: self._live().check_settings())
            told = msgspec.structs.replace(
                picture, trigger_count=count, exposure_us=exposure_us, gain_db=gain_db
            )
            return self._clock.timed(told, asked_ns, pulse)

    async def close(self) -> None:
        device, self._device = self._device, None
        await self._worker.close(device.close if device is not None else lambda: None)

    def _open(self) -> None:
        device = GenicamDevice(self._config)
        self.identity = device.open(self.identity.serial)
        self._device = device
        self.counter.restart()
        self._clock.restart()
        for _ in range(_CLOCK_READINGS):
            device.latch(self._clock.readings)

    def _live(self) -> GenicamDevice:
        """Return the open device; after it was lost, open it again by its serial number."""
        if self._device is None:
            raise CameraError("not-open")
        if self._device.lost:
            self._device.close()
            self._open()
        return self._device

    def _prepare(self) -> None:
        device = self._live()
        if extra := device.drain():
            raise self.counter.surplus(extra)
        device.latch(self._clock.readings)

    def _take(self, timeout_s: float) -> Image:
        """Trigger and wait for the frame, by `timeout_s` longer than its exposure takes."""
        device, limit_s = self._live(), timeout_s + self._config.exposure_us / 1e6
        if self._config.trigger == "software":
            device.trigger()
        picture = device.frame(limit_s)
        if picture is None:
            raise CameraError("no-image", limit_s=limit_s)
        return picture
