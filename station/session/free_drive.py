"""Capture without control: the operator guides the arm by hand, the station only looks and records."""

from __future__ import annotations

import asyncio
import logging

import numpy as np

from recordings.errors import RecordingError
from recordings.schema.messages import Vector6
from station.cell.errors import RefusedError, RobotError, StaleStateError, StationError, TriggerError
from station.cell.plan import Plan, PlannedPose
from station.cell.status import StationState
from station.cell.stillness import NotStillError
from station.protocol.verbs import Record
from station.session.bench import Bench
from station.session.capture import PoseFailedError, take_pose
from station.session.queue import GUIDED, PoseQueue
from station.session.recording import SessionRecording
from station.session.run import disk_failed, recover_parts, unmark_busy

log = logging.getLogger(__name__)

_GUIDE = "guide the arm by hand; the station does not move it"
NEW_PLACE_RAD = 0.1
"""Auto-record: some joint must have turned by this much since the last picture."""
WATCH_PERIOD_S = 0.1


class FreeDrive:
    """Nothing here moves the arm, so nothing here needs a go."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._taking = asyncio.Lock()
        self._watcher: asyncio.Task[None] | None = None
        self._last_place: Vector6 | None = None

    async def begin(self, auto: bool) -> None:
        """Opens the recording if none is open. `auto`: a picture whenever the arm rests anew."""
        if self.taking:
            raise RefusedError("the last picture is still ending: try again in a moment")
        self._end_watch()
        bench, store = self._bench, self._bench.store
        bench.cell.robot.check()
        bench.halting = False
        # At once, and taking: while the disk works nobody is offered a go, and no picture is begun.
        store.enter(StationState.FREE_DRIVE, "the recording is being opened")
        async with self._taking:
            try:
                await self._open_recording()
            except BaseException:
                if store.state in (StationState.FREE_DRIVE, StationState.PAUSED):
                    store.enter(bench.resting)
                raise
        if (refusal := Record.refusal(store.state)) is not None:
            raise refusal  # STOP, or the end of free drive, came in between
        store.enter(StationState.FREE_DRIVE, _GUIDE)
        bench.show_poses()
        self._last_place = None
        if auto:
            self._watcher = asyncio.create_task(self._watch())

    async def _open_recording(self) -> None:
        bench, before = self._bench, self._bench.recording
        if bench.queue is None:
            bench.queue = PoseQueue(Plan(bench.cell.config.robot.model, bench.cell.config.mount, ()))
        queue = bench.queue if before is not None else bench.queue.anew(guided=False)
        if before is not None and before.recorder is not None:
            return
        if before is not None:
            await recover_parts(bench, before)
        recording = before or SessionRecording(bench.root, bench.cell)
        picture = await bench.cell.camera.capture() if bench.cell.config.camera.model is None else None
        bench.recording = recording  # before it is open: after a STOP in between it must be closed
        try:
            await recording.open(queue, picture)
        except BaseException:
            bench.recording = before
            raise
        if before is None:
            bench.forget_session()
        bench.queue = queue

    def end(self) -> None:
        """To paused; the recording stays open."""
        self._end_watch()
        if self._bench.store.state is StationState.FREE_DRIVE:
            self._bench.store.enter(StationState.PAUSED, "free drive ended: go on, or finish")

    @property
    def taking(self) -> bool:
        """A picture is under way."""
        return self._taking.locked()

    async def last_picture(self) -> None:
        """Returns when the picture under way is taken; no further one is begun by itself."""
        async with self._taking:
            self._end_watch()

    def _end_watch(self) -> None:
        if self._watcher is not None:
            self._watcher.cancel()
            self._watcher = None

    async def record(self) -> int:
        """One picture here and now; its pose number. RefusedError when one is being taken already."""
        if self._taking.locked():
            raise RefusedError("a picture is being taken")
        async with self._taking:
            return await self._record()

    async def _record(self) -> int:
        bench = self._bench
        queue, store = bench.require_queue(), bench.store
        joints = bench.cell.robot.latest().joints_rad
        index = queue.add(PlannedPose(f"hand-{queue.next_index + 1:02d}", joints, why=GUIDED))
        attempt = queue.start_attempt(index)
        self._last_place = joints
        try:
            await take_pose(bench, index, attempt)
        except (PoseFailedError, NotStillError) as error:
            queue.mark(index, "failed", str(error))
            store.event(str(error), "warning", index)
        except RecordingError as error:
            disk_failed(bench, error)
            return index
        except (RobotError, TriggerError) as error:
            self._failed(str(error), index)
            return index
        except Exception as error:
            if not bench.halting:  # else STOP came in between: its state stays
                log.exception("a picture failed")
            self._failed(f"internal error ({error!r}); see the log", index)
        if not bench.halting and store.state is not StationState.FAULT:
            store.enter(StationState.FREE_DRIVE, _GUIDE)
        bench.show_poses(index)
        if bench.pause_wanted:
            bench.pause_wanted = ""
            self.end()
        return index

    def _failed(self, reason: str, index: int) -> None:
        unmark_busy(self._bench)
        if not self._bench.halting:
            self._bench.store.enter(StationState.FAULT, reason)
            self._bench.store.event(reason, "error", index)

    async def _watch(self) -> None:
        """For as long as free drive lasts."""
        while self._bench.store.state not in (StationState.PAUSED, StationState.IDLE):
            await asyncio.sleep(WATCH_PERIOD_S)
            if self._bench.store.state is not StationState.FREE_DRIVE:
                continue
            try:
                if self._at_rest_elsewhere():
                    await self.record()
            except StaleStateError:
                continue  # a hiccup of the news; a picture waits for better ones
            except StationError as error:
                self._bench.store.event(str(error), "warning")

    def _at_rest_elsewhere(self) -> bool:
        if not self._bench.stillness.at_rest:
            return False
        joints = self._bench.cell.robot.latest().joints_rad
        last = self._last_place
        return last is None or bool(np.abs(np.subtract(joints, last)).max() > NEW_PLACE_RAD)
