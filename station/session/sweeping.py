"""Carries out one approval for a sweep: swing after swing, images one after the other all the while."""

from __future__ import annotations

import asyncio
import threading

from recordings.schema.messages import Image
from station.analysis.worker import sight
from station.cell.errors import CameraError, LimitError, StationError
from station.cell.status import StationState
from station.devices.base import StreamingCamera
from station.session.capture import SIGHT_TIMEOUT_S, show_frame, take_image
from station.session.context import SessionContext
from station.session.lease import MotionApproval
from station.session.recording import SessionRecording
from station.session.run import FAILURES_IN_A_ROW, Run

BREATH_S = 0.02
"""Between two images, for whatever else the loop has to do: the arm's heartbeat first of all."""
SHOW_PERIOD_S = 0.1
"""Period at which a streaming camera's newest image is shown."""


class SweepRun(Run):
    """Every swing is a pose of the plan: checked like one, and done once its images are on the disk."""

    def __init__(self, context: SessionContext, go: MotionApproval) -> None:
        super().__init__(context, go)
        self._taken, self._ended = 0, threading.Event()

    async def _open_recording(self) -> None:
        """StationError without the board in view: a sweep that sees none shows nothing."""
        context, config = self._context, self._context.cell.config
        image = await take_image(context)
        seen = await context.workers.call(
            sight, image.viewable(), config.board, config.camera.model, timeout_s=SIGHT_TIMEOUT_S
        )
        if not seen.status.found:
            raise CameraError(
                f"A sweep begins with the board in view: {seen.status.reason or 'no board in the image'}.",
                code="no-board",
                remedy="Move the arm to where the camera sees the whole board.",
            )
        await super()._open_recording()

    async def _all_poses(self) -> None:
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._take_pictures())
                try:
                    await self._swings()
                finally:
                    self._ended.set()  # a camera may swallow being cancelled, just when its image comes
        except ExceptionGroup as failed:
            raise failed.exceptions[0] from None  # of two the first one tells the cause
        if not self._context.requests.halt:
            taken = self._taken
            self._context.store.event("swept", f"{taken} images while the arm moved", images=taken)

    async def _swings(self) -> None:
        context, queue = self._context, self._context.require_queue()
        for index in self._go.poses:
            if context.requests.halt or self._wants_rest() or self._failures >= FAILURES_IN_A_ROW:
                return
            if index not in queue.open:
                continue  # skipped or dropped since the approval
            context.require_recording().require_space()
            queue.start_attempt(index)
            try:
                await self._move_to(index)
            except LimitError as error:
                self._give_up(error)
                queue.mark(index, "failed", error)
                return
            context.store.enter(StationState.SETTLING)
            await context.require_recording().sync()
            queue.mark(index, "done")
            await context.require_recording().save_state(queue)
            context.show_poses(index)

    async def _take_pictures(self) -> None:
        """Until the arm rests, or the camera failed several times in a row."""
        camera, recording, failures = self._context.cell.camera, self._context.require_recording(), 0
        streaming = camera if isinstance(camera, StreamingCamera) and camera.free_running else None
        while not self._ended.is_set():
            if failures == FAILURES_IN_A_ROW:
                text = "The camera fails again and again: the sweep ends with this swing."
                self._give_up(CameraError(text, code="camera-fails", failures=failures))
                return
            before = self._taken
            try:
                if streaming is not None:
                    await self._stream(streaming, recording)
                else:
                    show_frame(self._context, self._keep(recording, await camera.capture()))
                    await asyncio.sleep(BREATH_S)
            except CameraError as error:
                failures = 1 if self._taken > before else failures + 1
                self._context.store.problem(error, said="image: {}")
            else:
                failures = 0

    def _keep(self, recording: SessionRecording, image: Image) -> Image:
        """Numbered and handed to the recorder; RecordingError when that cannot keep up."""
        numbered = recording.number(image)
        recording.image(numbered)
        self._taken += 1
        return numbered

    async def _stream(self, camera: StreamingCamera, recording: SessionRecording) -> None:
        """Every frame, straight from the camera's thread; what is shown of them comes from the loop."""
        newest: list[Image] = []

        def keep(image: Image) -> None:
            if not self._ended.is_set():  # the arm stopped while it was on its way
                newest[:] = [self._keep(recording, image)]

        async def show() -> None:
            while True:
                await asyncio.sleep(SHOW_PERIOD_S)
                if newest:
                    show_frame(self._context, newest[0])

        showing = asyncio.create_task(show())
        try:
            await camera.stream(keep, self._ended)
        finally:
            showing.cancel()

    def _give_up(self, error: StationError) -> None:
        """The arm rests after this swing; a person decides."""
        self._failures, self._why = FAILURES_IN_A_ROW, str(error)
        self._context.store.problem(error, "error")
