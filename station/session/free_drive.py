"""Capture without control: the operator guides the arm by hand, the station only looks and records."""

from __future__ import annotations

import asyncio

import numpy as np

from recordings.errors import RecordingError
from recordings.messages import Vector6
from station.errors import RefusedError, RobotError, StationError
from station.plan.model import Plan, PlannedPose
from station.session.bench import Bench
from station.session.capture import PoseFailedError, take_pose
from station.session.queue import PoseQueue
from station.session.recording import SessionRecording
from station.session.run import disk_failed, recover_parts, unmark_busy
from station.states import TransitionError
from station.status import StationState
from station.stillness import NotStillError

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
        self._end_watch()
        bench = self._bench
        bench.cell.robot.check()
        if bench.queue is None:
            bench.queue = PoseQueue(Plan(bench.cell.config.robot.model, bench.cell.config.mount, ()))
        if bench.recording is None or bench.recording.recorder is None:
            if bench.recording is not None:
                await recover_parts(bench, bench.recording)
            recording = bench.recording or SessionRecording(bench.root, bench.cell)
            picture = await bench.cell.camera.capture() if bench.cell.config.camera.model is None else None
            await recording.open(bench.queue, picture)
            bench.recording = recording
        bench.halting = False
        bench.store.enter(StationState.FREE_DRIVE, "guide the arm by hand; the station does not move it")
        bench.show_poses()
        self._last_place = None
        if auto:
            self._watcher = asyncio.create_task(self._watch())

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
        index = queue.add(PlannedPose(f"hand-{queue.next_index + 1:02d}", joints, why="guided by hand"))
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
        except RobotError as error:
            unmark_busy(bench)
            if not bench.halting:
                store.enter(StationState.FAULT, str(error))
                store.event(str(error), "error", index)
            return index
        except TransitionError:
            if not bench.halting:
                raise
            unmark_busy(bench)  # STOP came in between: its state stays
        if not bench.halting:
            store.enter(StationState.FREE_DRIVE, "guide the arm by hand; the station does not move it")
        bench.show_poses(index)
        if bench.pause_wanted:
            bench.pause_wanted = ""
            self.end()
        return index

    async def _watch(self) -> None:
        """For as long as free drive lasts."""
        while self._bench.store.state not in (StationState.PAUSED, StationState.IDLE):
            await asyncio.sleep(WATCH_PERIOD_S)
            if self._bench.store.state is StationState.FREE_DRIVE and self._at_rest_elsewhere():
                try:
                    await self.record()
                except StationError as error:
                    self._bench.store.event(str(error), "warning")

    def _at_rest_elsewhere(self) -> bool:
        if not self._bench.stillness.at_rest:
            return False
        joints = self._bench.cell.robot.latest().joints_rad
        last = self._last_place
        return last is None or bool(np.abs(np.subtract(joints, last)).max() > NEW_PLACE_RAD)
