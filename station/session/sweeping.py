"""Carries out one go for a sweep: swing after swing, pictures one after the other all the while."""

from __future__ import annotations

import asyncio

from station.analysis import sight
from station.errors import CameraError, LimitError
from station.session.bench import Bench
from station.session.capture import SIGHT_TIMEOUT_S, show_frame
from station.session.lease import Go
from station.session.run import FAILURES_IN_A_ROW, Run
from station.status import StationState

BREATH_S = 0.02
"""Between two pictures, for whatever else the loop has to do: the arm's heartbeat first of all."""


class SweepRun(Run):
    """Every swing is a pose of the plan: checked like one, and done once its pictures are on the disk."""

    def __init__(self, bench: Bench, go: Go) -> None:
        super().__init__(bench, go)
        self._pictures, self._ended = 0, False

    async def _open_recording(self) -> None:
        """CameraError without the board in view: a sweep that sees none is worth nothing."""
        bench, config = self._bench, self._bench.cell.config
        picture = await bench.cell.camera.capture()
        seen = await bench.workers.call(
            sight, picture.image, config.board, config.camera.model, timeout_s=SIGHT_TIMEOUT_S
        )
        if not seen.status.found:
            raise CameraError(
                f"a sweep begins with the board in view: {seen.status.reason or 'no board in the picture'}. "
                "Nothing moved: bring the arm to where the camera sees the whole board"
            )
        await super()._open_recording()

    async def _poses(self) -> None:
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._take_pictures())
                try:
                    await self._swings()
                finally:
                    self._ended = True  # a camera may swallow being cancelled, just when its picture comes
        except ExceptionGroup as failed:
            raise failed.exceptions[0] from None  # of two the first one tells the cause
        if not self._bench.halting:
            self._bench.store.event(f"{self._pictures} pictures while the arm moved")
            await self._rest()

    async def _swings(self) -> None:
        bench, queue = self._bench, self._bench.require_queue()
        for index in self._go.poses:
            if bench.halting or self._wants_rest() or self._failures >= FAILURES_IN_A_ROW:
                return
            bench.require_recording().require_space()
            queue.start_attempt(index)
            try:
                await self._move_to(index)
            except LimitError as error:
                self._give_up(str(error))
                queue.mark(index, "failed", str(error))
                return
            bench.store.enter(StationState.SETTLING)
            await bench.require_recording().sync()
            queue.mark(index, "done")
            await bench.require_recording().save_state(queue)
            bench.show_poses(index)

    async def _take_pictures(self) -> None:
        """Until the arm rests, or until the camera failed several times in a row."""
        bench, failures = self._bench, 0
        while not self._ended:
            if failures == FAILURES_IN_A_ROW:
                self._give_up("the camera fails again and again: the sweep ends with this swing")
                return
            try:
                picture = await bench.cell.camera.capture()
            except CameraError as error:
                failures += 1
                bench.store.event(f"picture: {error}", "warning")
                continue
            failures = 0
            numbered = bench.require_recording().number(picture)
            bench.require_recording().picture(numbered)
            self._pictures += 1
            show_frame(bench, numbered)
            await asyncio.sleep(BREATH_S)

    def _give_up(self, reason: str) -> None:
        """The arm rests after this swing; a person decides."""
        self._failures = FAILURES_IN_A_ROW
        self._bench.store.event(reason, "error")
