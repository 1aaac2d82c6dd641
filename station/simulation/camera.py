"""Camera of a simulated cell, whose images are rendered in another process from the arm's true pose."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time

import msgspec
import numpy as np

from recordings.schema.messages import CameraIdentity, ClockReading, Image, Stamps
from station.cell.config import CameraConfig
from station.cell.errors import CameraError
from station.cell.status import CameraCounts, FrameTiming
from station.devices.base import Trigger
from station.devices.frame_ids import FrameIds
from station.devices.frames import FrameClock, FrameCounter, TriggerPulse
from station.simulation.launch import Json
from station.simulation.truth import CellTruth

START_TIMEOUT_S = 20.0
_ANSWER_S = 5.0
_CLOCK_READINGS = 8
_PIPE_LIMIT = 4 * 2**20


class RenderedCamera:
    """Rendered camera behind `devices.base.Camera`. `controller_host`: the simulated arm's address."""

    def __init__(
        self,
        truth: CellTruth,
        controller_host: str,
        config: CameraConfig | None = None,
        trigger: Trigger | None = None,
    ) -> None:
        """`trigger`: the box that fires it, whose pulses reach `pulse`; None: triggered by software."""
        self._truth = truth
        self._trigger = trigger
        self._loop: asyncio.AbstractEventLoop | None = None
        self._host = controller_host
        self._exposure_us = truth.exposure_us if config is None else config.exposure_us
        self._gain_db = truth.gain_db if config is None else config.gain_db
        self._process: asyncio.subprocess.Process | None = None
        self._reader: asyncio.Task[None] | None = None
        self._frames: asyncio.Queue[Image | CameraError] = asyncio.Queue()
        self._answers: asyncio.Queue[Image | Json | CameraError] = asyncio.Queue()
        self._asking = asyncio.Lock()
        self._clock = FrameClock()
        self.counter = FrameCounter(FrameIds.BLOCK)

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

    def pulse(self) -> None:
        """Deliver an edge on the trigger line; from any thread. Ignored while the camera is not open."""
        if self._loop is not None and self._process is not None:
            self._loop.call_soon_threadsafe(self._write, {"cmd": "trigger"})

    async def open(self) -> CameraIdentity:
        """Start the process and read its clock a few times."""
        self._loop = asyncio.get_running_loop()
        self._process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "station.simulation.camera_process"),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=_PIPE_LIMIT,
        )
        self._frames, self._answers = asyncio.Queue(), asyncio.Queue()
        self.counter.restart()
        self._reader = asyncio.create_task(self._read(self._process))
        setup = {
            "truth": msgspec.to_builtins(self._truth),
            "controller_host": self._host,
            "exposure_us": self._exposure_us,
            "gain_db": self._gain_db,
        }
        try:
            async with self._asking:  # so that images are taken only after the clock was read
                await self._ask_locked(setup, START_TIMEOUT_S)
                self._clock.restart()  # not before: a clock without readings counts as unreadable
                for _ in range(_CLOCK_READINGS):
                    await self._read_clock()
        except BaseException:
            await self.close()
            raise
        return self.identity

    async def capture(self, timeout_s: float = 5.0) -> Image:
        """Trigger once and return that frame; a frame from before the trigger is an error."""
        async with self._asking:
            await self._read_clock()
            if surplus := self._frames.qsize():
                self._frames = asyncio.Queue()
                raise self.counter.surplus(surplus)
            pulse: TriggerPulse | None = None
            asked_ns = time.monotonic_ns()
            if self._trigger is None:
                self._write({"cmd": "trigger"})
            else:
                pulse = await self._trigger.fire()
            try:
                frame = await asyncio.wait_for(self._frames.get(), timeout_s)
            except TimeoutError:
                self.counter.lost(None if pulse is None else pulse.count)
                raise CameraError("no-image", limit_s=timeout_s) from None
            if isinstance(frame, CameraError):
                raise frame
            count = None if pulse is None else pulse.count
            sequence = self.counter.accept(frame.frame_id, count)
            self._check_settings(frame)
            told = msgspec.structs.replace(frame, sequence=sequence, trigger_count=count)
            return self._clock.timed(told, asked_ns=asked_ns, pulse=pulse)

    async def settings(self) -> dict[str, object]:
        return {
            "pixel_format": "Mono8",
            "region": [0, 0, self._truth.camera.width, self._truth.camera.height],
            "exposure_us": self._exposure_us,
            "gain_db": self._gain_db,
        }

    async def glimpse(self) -> Image | None:
        """Render a new image at half the size."""
        picture = await self._ask({"cmd": "preview"}, _ANSWER_S)
        assert isinstance(picture, Image)
        return picture

    async def preview(self) -> Image | None:
        try:
            return await self.glimpse()
        except CameraError:
            return None

    async def inject(self, fault: str, value: object = None) -> None:
        """Inject a fault of `CameraFaults`; 'unplugged' ends the process."""
        if fault == "unplugged":
            self._write({"cmd": "fault", "name": fault})
            return
        await self._ask({"cmd": "fault", "name": fault, "value": value}, _ANSWER_S)

    async def close(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            assert process.stdin is not None
            process.stdin.close()
            try:
                await asyncio.wait_for(process.wait(), 2.0)
            except TimeoutError:
                process.kill()
                await process.wait()
        if self._reader is not None:
            self._reader.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._reader
            self._reader = None

    def _check_settings(self, frame: Image) -> None:
        found, wanted = (frame.exposure_us, frame.gain_db), (self._exposure_us, self._gain_db)
        if found != wanted:
            found_text, wanted_text = (f"{us:g} µs and {db:g} dB" for us, db in (found, wanted))
            raise CameraError("settings-changed", found=found_text, wanted=wanted_text)

    async def _read_clock(self) -> None:
        asked_ns = time.monotonic_ns()
        answer = await self._ask_locked({"cmd": "clock"}, _ANSWER_S)
        if isinstance(answer, dict):
            answered_ns, wall_ns = time.monotonic_ns(), time.time_ns()
            self._clock.readings.add(ClockReading(asked_ns, answered_ns, answer["device_ns"], wall_ns))

    async def _ask(self, request: Json, timeout_s: float) -> Image | Json:
        async with self._asking:
            return await self._ask_locked(request, timeout_s)

    async def _ask_locked(self, request: Json, timeout_s: float) -> Image | Json:
        while not self._answers.empty():
            self._answers.get_nowait()  # discard answers that came too late
        self._write(request)
        try:
            answer = await asyncio.wait_for(self._answers.get(), timeout_s)
        except TimeoutError:
            raise CameraError("camera-silent", limit_s=timeout_s) from None
        if isinstance(answer, CameraError):
            raise answer
        return answer

    def _write(self, request: Json) -> None:
        if self._process is None or self._process.stdin is None or self._process.returncode is not None:
            raise CameraError("not-open")
        self._process.stdin.write(json.dumps(request).encode() + b"\n")

    async def _read(self, process: asyncio.subprocess.Process) -> None:
        """Distribute the process's messages until it ends; then fail all waiting calls."""
        assert process.stdout is not None
        try:
            while line := await process.stdout.readline():
                header = json.loads(line)
                match header["kind"]:
                    case "frame":
                        self._frames.put_nowait(await _picture(process.stdout, header))
                    case "preview":
                        self._answers.put_nowait(await _picture(process.stdout, header))
                    case "error":
                        error = CameraError("camera-refused", doing=header["cmd"], reason=header["text"])
                        (self._frames if header["cmd"] == "trigger" else self._answers).put_nowait(error)
                    case _:
                        self._answers.put_nowait(header)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass  # it ended within a frame
        gone = CameraError("camera-gone", camera=self.identity.serial)
        self._frames.put_nowait(gone)
        self._answers.put_nowait(gone)


async def _picture(stream: asyncio.StreamReader, header: Json) -> Image:
    data = await stream.readexactly(header["bytes"])
    return Image(
        pixels=np.frombuffer(data, np.uint8).reshape(header["height"], header["width"]),
        stamps=Stamps(
            host_monotonic_ns=header["arrival_monotonic_ns"],
            host_wall_ns=time.time_ns() - (time.monotonic_ns() - header["arrival_monotonic_ns"]),
            device_ns=header["device_ns"],
        ),
        frame_id=header["frame_id"],
        sequence=0,
        exposure_us=header["exposure_us"],
        gain_db=header["gain_db"],
    )
