"""Shared state of a session's parts, and the status that is published to watchers."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from calibrate.views.view_set import BoardView
from recordings.errors import CodedError, RecordingError, Value, plain_value
from recordings.plain_text import plain_text
from recordings.recorder import Recorder
from recordings.recover import recover_recording
from recordings.schema.messages import CaptureEvent, RobotState, Stamps
from station.analysis.pool import Workers
from station.cell.errors import RefusedError
from station.cell.session_folder import SessionState
from station.cell.status import (
    NOTHING_SEEN,
    OLD_S,
    DetectionStatus,
    Event,
    Level,
    SessionStatus,
    StationState,
    StationStatus,
    differ,
)
from station.cell.stillness import StillnessMonitor
from station.devices.base import wait_for_state
from station.devices.cell import Cell
from station.protocol.states import LATCHED, check_transition
from station.session.queue import PoseQueue
from station.session.recording import SessionRecording
from station.session.threads import DISK

log = logging.getLogger("station.events")

EVENTS_KEPT = 100
EVENT_TEXT_LIMIT = 400
REASON_LIMIT = 4000
"""Most characters of the reason of a state: an error may quote a file."""


@dataclass
class RunRequests:
    """Requests to the run under way."""

    pause_by: str = ""
    """Client that asked to pause after this pose; empty: none."""
    finish: bool = False
    """Finish after this pose."""
    halt: bool = False
    """STOP, a fault or lost control ended the run, which must not change the state any more."""


@dataclass(frozen=True, eq=False)
class Loaded:
    """What is loaded and shown: a plan's poses, and the session they are of."""

    queue: PoseQueue | None = None
    """None: no plan."""
    session: SessionStatus = field(default_factory=SessionStatus)


@dataclass(eq=False)
class SessionContext:
    """Shared state of a session. For the event loop's thread only, unless stated otherwise."""

    cell: Cell
    store: StatusStore
    workers: Workers
    stillness: StillnessMonitor
    root: Path
    queue: PoseQueue | None = None
    recording: SessionRecording | None = None
    """Recording of the open session; None: no session is open."""
    seen: dict[int, BoardView] = field(default_factory=dict)
    """Pose number → view that counts."""
    replaced: Loaded | None = None
    """What the loaded plan replaced, until a session begins with it."""
    before_check: Loaded = field(default_factory=Loaded)
    """What stood before a drift check, and stands again after it."""
    requests: RunRequests = field(default_factory=RunRequests)

    @property
    def resting(self) -> StationState:
        """State between motions: `paused` with an open session, else `idle`."""
        return StationState.IDLE if self.recording is None else StationState.PAUSED

    def loaded(self) -> PoseQueue:
        """Return the loaded plan's poses. RefusedError when no plan is loaded."""
        if self.queue is None:
            raise RefusedError("no-plan")
        return self.queue

    def require_recording(self) -> SessionRecording:
        assert self.recording is not None
        return self.recording

    async def ready_state(self) -> RobotState:
        """Wait for a current state of an arm that may be captured, and return it. Raises RobotError."""
        return await wait_for_state(self.cell.arm, checked=True)

    @property
    def recorder(self) -> Recorder | None:
        """Writer of the open file; None without one. From any thread."""
        recording = self.recording
        return recording.recorder if recording is not None else None

    def record_state(self, state: RobotState) -> None:
        """Record a state of the arm while a recording is open."""
        if (recorder := self.recorder) is not None:
            recorder.robot_state(state)

    def record_event(self, event: Event) -> None:
        """Record an event. Errors of the disk are ignored, as they are reported elsewhere."""
        if (recorder := self.recorder) is not None and recorder.error is None:
            stamps = Stamps(host_monotonic_ns=time.monotonic_ns(), host_wall_ns=event.wall_ns)
            with contextlib.suppress(RecordingError):
                recorder.event(CaptureEvent(stamps, "station", event.pose_index, event.text, event.level))

    async def open_recording(self, queue: PoseQueue, check: bool = False) -> None:
        """Open the session's next file if none is open; begin a session if there is none.

        `check`: as a drift check. On RecordingError or StationError nothing has changed.
        """
        if self.recorder is not None:
            return
        before = self.recording
        image = await self.cell.camera.capture() if self.cell.config.camera.model is None else None
        if before is not None:
            await self.recover_segments(before)
        recording = before
        if recording is None:
            recording = await DISK.run(SessionRecording, self.root, self.cell, check=check)
        # Set before opening, as STOP may interrupt it: a file opened by then must be closed.
        self.recording = recording
        try:
            await recording.open(queue, image)
        except Exception:
            self.recording = before
            raise

    async def recover_segments(self, recording: SessionRecording) -> None:
        """Recover segments that a crash left open, before the next segment. Raises RecordingError."""
        await recording.released()
        async with recording.recovering:
            if await DISK.run(recording.unfinished_segments):
                for found in await self.workers.call(recover_recording, recording.folder):
                    self.store.event("recovered", f"recovered {found.text}")
            await DISK.run(recording.count_segments)

    def restore(self, folder: Path, state: SessionState) -> None:
        """Show an interrupted session's poses, in state `stopped` until acknowledged. Nothing moves.

        A session that another cell began stays as it is on the disk, and an event names both.
        """
        recording = SessionRecording(
            self.root, self.cell, folder, state.parts, state.elapsed_s, state.check, state.first
        )
        advice = (
            "Start the station of that cell to go on with it. "
            f"`recordings recover {shlex.quote(str(folder))}` saves what was recorded."
        )
        try:
            recording.require_same_cell(connected=False, advice=advice)
            if state.first is None:
                _require_same_plan(self.cell, folder, state, advice)
        except RefusedError as elsewhere:
            self.store.problem(elsewhere)
            return
        self.queue = PoseQueue(state.plan, state.poses)
        self.recording = recording
        reason = (
            f"The daemon ended during session {folder.name}. Saved: {self.queue.done} of "
            f"{len(self.queue.statuses)} poses. Look at the arm, acknowledge, then resume or finish."
        )
        self.store.enter(StationState.STOPPED, reason, "interrupted")
        self.show_poses()
        self.store.update_session(elapsed_s=state.elapsed_s, check=state.check)
        self.store.event("interrupted", reason, "warning", captured=self.queue.done)

    def require_same_cell(self, *, connected: bool = True) -> None:
        """Raise RefusedError `interrupted-elsewhere` where another cell or device began the open session.

        `connected`: False while devices may not have told yet who they are.
        """
        if self.recording is not None:
            self.recording.require_same_cell(connected=connected)

    @property
    def standing(self) -> Loaded:
        """What is loaded and shown now."""
        return Loaded(self.queue, self.store.status.session)

    def stand_again(self, before: Loaded) -> None:
        """Load and show what stood before."""
        self.queue = before.queue
        self.store.update(session=before.session)

    def forget_session(self) -> None:
        """Clear the last session from the status."""
        self.seen.clear()
        self.store.update(session=SessionStatus(), checked=SessionStatus())

    def begin_session(self, before_check: Loaded | None = None) -> None:
        """Show a new session in place of the last one.

        `before_check`: what stands again after a drift check; None: it is none.
        """
        self.before_check = before_check or Loaded()
        self.replaced = None
        self.forget_session()
        self.store.update_session(check=before_check is not None)

    def end_check(self) -> None:
        """After a drift check show again what stood before it; `checked` tells what was recorded.

        Does nothing in another session, or while its recording is open.
        """
        check = self.store.status.session
        if not check.check or self.recording is not None:
            return
        self.seen.clear()
        self.stand_again(self.before_check)
        self.before_check = Loaded()
        if check.recording:
            self.store.update(checked=check)

    def show_poses(self, current: int | None = None) -> None:
        """Update the status from queue and recording. `current`: number of the pose under way."""
        queue, recording = self.queue, self.recording
        if queue is None:
            self.store.update(session=SessionStatus())
            return
        named = {"name": recording.name, "folder": str(recording.folder)} if recording else {}
        self.store.update_session(
            poses=queue.statuses,
            working_distance_m=queue.plan.working_distance_m,
            floor_mm=None if queue.plan.floor_m is None else round(1000 * queue.plan.floor_m, 4),
            current=current,
            captured=queue.done,
            **named,
        )


def _require_same_plan(cell: Cell, folder: Path, state: SessionState, advice: str) -> None:
    """Compare what an older session tells of the cell that began it. RefusedError `interrupted-elsewhere`."""
    config = cell.config
    for what, first, now in (
        ("source", state.source, cell.source),
        ("mounting", state.plan.mount, config.mount),
        ("robot", state.plan.robot, config.robot.model),
    ):
        if first != now:
            raise RefusedError(
                "interrupted-elsewhere",
                session=folder.name,
                what=what,
                first=first,
                now=now,
                folder=folder,
                advice=advice,
            )


def _cut(text: str, limit: int = REASON_LIMIT) -> str:
    """Shorten a text, and put signs for what neither a terminal nor a recording takes."""
    return plain_text(text if len(text) <= limit else text[: limit - 1] + "…")


def _cut_value(value: Value) -> Value:
    """Shorten the value of an event, of which a hundred are kept and sent."""
    if isinstance(value, str):
        return _cut(value, EVENT_TEXT_LIMIT)
    if isinstance(value, list):
        return [
            _cut(each, EVENT_TEXT_LIMIT) if isinstance(each, str) else each for each in value[:EVENTS_KEPT]
        ]
    return value


class StatusStore:
    """Newest status, with callbacks for changes. For the event loop's thread only."""

    def __init__(self, status: StationStatus) -> None:
        self.status = status
        self._watchers: list[Callable[[], None]] = []
        self._detection_ends: asyncio.TimerHandle | None = None
        """When the shown detection is old; None: there was none yet."""
        self.recorded: Callable[[Event], None] = lambda event: None
        """Called for every event, to record it."""
        self.latched: Callable[[str, str, StationState], None] = lambda reason, cause, state: None
        """Called with reason, cause and state when `stopped` or `fault` is entered, to hold the latch."""

    @property
    def state(self) -> StationState:
        return self.status.state

    def watch(self, changed: Callable[[], None]) -> None:
        """Call `changed` after every change."""
        self._watchers.append(changed)

    def update(self, **sections: object) -> None:
        changed = {k: v for k, v in sections.items() if differ(getattr(self.status, k), v)}
        if changed:
            self.status = msgspec.structs.replace(self.status, **changed)
            for watcher in self._watchers:
                try:
                    watcher()
                except Exception:  # an observer's error must not prevent STOP
                    log.exception("a watcher of the status failed")

    def update_session(self, **fields: object) -> None:
        self.update(session=msgspec.structs.replace(self.status.session, **fields))

    def show_detection(self, detection: DetectionStatus, lasts_s: float = OLD_S) -> None:
        """Show what an image shows of the board until that is old: then the board is not looked at.

        So whoever reads the status never takes it for the present, also where nobody asks for images any
        more, or the worker ended or hangs.
        """
        if self._detection_ends is not None:
            self._detection_ends.cancel()
        self.update(detection=detection)
        self._detection_ends = asyncio.get_running_loop().call_later(
            lasts_s, lambda: self.update(detection=NOTHING_SEEN)
        )

    def enter(self, state: StationState, reason: str | CodedError = "", cause: str = "") -> None:
        """Enter a state; `reason` is for people, `cause` for programs. TransitionError: not allowed."""
        if state is not self.state:
            check_transition(self.state, state)
        if isinstance(reason, CodedError):
            cause = reason.code
        self.update(state=state, reason=_cut(str(reason)), cause=cause)
        if state in LATCHED:
            self.latched(str(reason), cause, state)

    def event(
        self, code: str, text: str, level: Level = "info", pose_index: int | None = None, /, **values: Value
    ) -> None:
        """Publish an event to status, log and recording; `code` and `values` are for programs."""
        text = _cut(text, EVENT_TEXT_LIMIT)
        plain = {name: _cut_value(plain_value(value)) for name, value in values.items()}
        event = Event(time.time_ns(), level, text, pose_index, code, plain)
        pose = f"pose {pose_index + 1}: " if pose_index is not None else ""
        log.log(getattr(logging, level.upper()), "%s%s", pose, text)
        self.update(events=(*self.status.events, event)[-EVENTS_KEPT:])
        self.recorded(event)

    def problem(
        self, error: Exception, level: Level = "warning", pose_index: int | None = None, said: str = "{}"
    ) -> None:
        """Publish an error as an event; `said`: sentence with {} for the error's text."""
        code, values = (error.code, error.values) if isinstance(error, CodedError) else ("internal", {})
        self.event(code, said.format(error), level, pose_index, **values)
