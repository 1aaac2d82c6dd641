"""Camera of a simulated cell, whose images are rendered in another process from the arm's true pose."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec

from recordings.geometry import Array
from recordings.schema.messages import CameraIdentity, Image
from station.analysis.pool import WorkerError, Workers
from station.cell.config import CameraConfig
from station.cell.errors import CameraError, RobotError
from station.cell.status import CameraCounts, FrameTiming
from station.devices.frames import FrameClock, FrameCounter
from station.simulation.camera_process import ask, start_camera
from station.simulation.truth import CellTruth

_ANSWER_S = 5.0
_CLOCK_READINGS = 8


class RenderedCamera:
    """Rendered camera behind `devices.base.Camera`. `controller_host`: the simulated arm's address."""

    def __init__(
        self,
        truth: CellTruth,
        controller_host: str,
        config: CameraConfig | None = None,
        flange: Callable[[], Array] | None = None,
    ) -> None:
        """`flange`: returns base_from_flange (4, 4) of a posted arm; None: the controller is asked for it."""
        self._flange = flange
        if config is not None:
            changes = {"exposure_us": config.exposure_us, "gain_db": config.gain_db}
            truth = msgspec.structs.replace(truth, light=msgspec.structs.replace(truth.light, **changes))
        self._truth = truth
        self._host = controller_host
        self._workers: Workers | None = None
        """The camera's process; None: not open."""
        self._lost = False
        """Its process died, or was too late; the next one is another camera."""
        self._asking = asyncio.Lock()
        self._clock = FrameClock()
        self.counter = FrameCounter()

    @property
    def identity(self) -> CameraIdentity:
        return CameraIdentity(
            vendor="Daheng Imaging (simulated)",
            model="MER-131-75GM",
            serial=f"SIM{self._truth.seed:05d}",
            driver="rendered",
        )

    @property
    def timing(self) -> FrameTiming | None:
        return self._clock.timing

    def counts(self) -> CameraCounts:
        return self.counter.counts()

    async def open(self) -> CameraIdentity:
        """Start the process and read its clock a few times."""
        try:
            async with self._asking:  # so that images are taken only after the clock was read
                await self._open()
        except BaseException:
            await self.close()
            raise
        return self.identity

    async def _open(self) -> None:
        if self._workers is None:
            self._workers = Workers(partial(start_camera, self._truth, self._host))
        self._lost = False
        self.counter.restart()
        await self._call("clock")  # answered when the process has started
        self._clock.restart()  # not before: a clock without readings counts as unreadable
        for _ in range(_CLOCK_READINGS):
            await self._read_clock()

    async def capture(self, timeout_s: float = 5.0) -> Image:
        """Trigger once and return that frame."""
        return await asyncio.shield(self._triggered(timeout_s))

    async def _triggered(self, timeout_s: float) -> Image:
        async with self._asking:
            await self._ready()
            await self._read_clock()
            asked_ns = time.monotonic_ns()
            frame = await self._call("trigger", timeout_s=timeout_s)
            self.counter.accept(frame.frame_id)
            return self._clock.timed(frame, asked_ns)

    async def settings(self) -> dict[str, object]:
        return {
            "pixel_format": "Mono8",
            "region": [0, 0, self._truth.camera.width, self._truth.camera.height],
            "exposure_us": self._truth.light.exposure_us,
            "gain_db": self._truth.light.gain_db,
        }

    async def glimpse(self) -> Image:
        """Render a new image at half the size."""
        async with self._asking:
            await self._ready()
            image: Image = await self._call("preview")
            return image

    async def close(self) -> None:
        workers, self._workers, self._lost = self._workers, None, False
        if workers is not None:
            workers.close()  # ends a call that is under way, too

    async def _ready(self) -> None:
        """Open it again when it was lost, as other drivers do, and bring it to where a posted arm is now.

        CameraError where nothing is posted.
        """
        if self._lost:
            await self._open()
        if self._flange is None:
            return
        try:
            place = self._flange()
        except RobotError as error:
            raise CameraError.from_data(error.data) from None
        await self._call("place", place)

    async def _read_clock(self) -> None:
        asked_ns = time.monotonic_ns()
        device_ns = await self._call("clock")
        self._clock.readings.add(asked_ns, time.monotonic_ns(), device_ns)

    async def _call(self, name: str, *arguments: object, timeout_s: float = _ANSWER_S) -> Any:
        if self._workers is None:
            raise CameraError("not-open")
        try:
            # A cancelled call would end the process.
            return await asyncio.shield(self._workers.call(ask, name, *arguments, timeout_s=timeout_s))
        except WorkerError:
            self._lost = self._workers is not None  # else it was closed meanwhile
            raise CameraError("camera-gone", camera=self.identity.serial) from None
        except RobotError as error:
            raise CameraError("camera-refused", doing=name, reason=str(error)) from None
