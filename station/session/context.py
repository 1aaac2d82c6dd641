"""What every part of a session works with."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array
from recordings.errors import RecordingError
from recordings.schema.messages import RobotState
from station.analysis.pool import Workers
from station.cell.collision import CellGeometry
from station.cell.status import Event, SessionStatus, StationState
from station.cell.stillness import StillnessMonitor
from station.devices.cell import Cell
from station.session.queue import PoseQueue
from station.session.recording import SessionRecording
from station.session.store import StatusStore


@dataclass(frozen=True, eq=False)
class CapturedView:
    """A pose that counts, as far as the running estimate needs it."""

    index: int
    base_from_flange: Array
    indices: NDArray[np.intp]
    pixels: Array


@dataclass(eq=False)
class SessionContext:
    """Touched by the event loop's thread only."""

    cell: Cell
    geometry: CellGeometry
    store: StatusStore
    workers: Workers
    stillness: StillnessMonitor
    root: Path
    queue: PoseQueue | None = None
    recording: SessionRecording | None = None
    """Of the session that is not sealed yet."""
    seen: dict[int, CapturedView] = field(default_factory=dict)
    pause_wanted: str = ""
    """Who asked to pause after this pose; empty = nobody."""
    finish_wanted: bool = False
    halting: bool = False
    """STOP, a fault or a lost lease ends the run: it must not change the state any more."""

    @property
    def resting(self) -> StationState:
        """Where the station stands between two goes: `paused` always has a session to go on with."""
        return StationState.IDLE if self.recording is None else StationState.PAUSED

    def require_queue(self) -> PoseQueue:
        """Inside a run there always is one."""
        assert self.queue is not None
        return self.queue

    def require_recording(self) -> SessionRecording:
        assert self.recording is not None
        return self.recording

    def record_state(self, state: RobotState) -> None:
        """Every sample of the arm, while a recording is open; from the reader's thread."""
        if (recording := self.recording) is not None:
            recording.robot_state(state)

    def record_event(self, event: Event) -> None:
        if self.recording is not None:
            with contextlib.suppress(RecordingError):
                self.recording.event(event)

    def forget_session(self, check: bool = False) -> None:
        """What is shown of the session before ends when the next one begins; `check`: as a drift check."""
        self.seen.clear()
        session = self.store.status.session
        fresh = msgspec.structs.replace(
            session,
            name="",
            folder="",
            recording="",
            calibration="",
            check=check,
            elapsed_s=0.0,
            remaining_s=None,
        )
        self.store.update(session=fresh)

    def show_poses(self, current: int | None = None) -> None:
        """Brings the status up to date with the queue and the recording."""
        queue, recording = self.queue, self.recording
        old = self.store.status.session
        if queue is None:
            self.store.update(session=SessionStatus(source=self.cell.source))
            return
        self.store.update(
            session=SessionStatus(
                name=recording.name if recording else old.name,
                folder=str(recording.folder) if recording else old.folder,
                plan_sha256=queue.sha256,
                poses=queue.statuses,
                current=current,
                captured=queue.done,
                elapsed_s=old.elapsed_s,
                remaining_s=old.remaining_s,
                recording=old.recording,
                calibration=old.calibration,
                check=old.check,
                source=self.cell.source,
            )
        )
