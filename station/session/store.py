"""The one status of the station. Everything that changes it goes through here; watchers are told."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

import msgspec

from recordings.errors import CodedError, Value
from station.cell.status import Event, Level, StationState, StationStatus
from station.protocol.states import check_transition

log = logging.getLogger("station.events")

EVENTS_KEPT = 100
EVENT_TEXT_LIMIT = 400


class StatusStore:
    """Holds the newest immutable snapshot. Only the event loop's thread may call it."""

    def __init__(self, status: StationStatus) -> None:
        self.status = status
        self._watchers: list[Callable[[], None]] = []
        self._listeners: list[Callable[[Event], None]] = []

    @property
    def state(self) -> StationState:
        return self.status.state

    def watch(self, changed: Callable[[], None]) -> Callable[[], None]:
        """`changed` is called after every change; returns what ends it, however often it is called."""
        self._watchers.append(changed)

        def end() -> None:
            if changed in self._watchers:
                self._watchers.remove(changed)

        return end

    def on_event(self, listener: Callable[[Event], None]) -> None:
        """The recording keeps what people are told."""
        self._listeners.append(listener)

    def update(self, **sections: object) -> None:
        changed = {k: v for k, v in sections.items() if getattr(self.status, k) != v}
        if changed:
            self.status = msgspec.structs.replace(self.status, **changed)
            for watcher in list(self._watchers):
                try:
                    watcher()
                except Exception:  # who only looks on must not come between STOP and the arm
                    log.exception("a watcher of the status failed")

    def update_session(self, **fields: object) -> None:
        self.update(session=msgspec.structs.replace(self.status.session, **fields))

    def enter(self, state: StationState, reason: str | CodedError = "", cause: str = "") -> None:
        """`reason` for people, `cause` for programs. TransitionError for a step not in the table."""
        if state is not self.state:
            check_transition(self.state, state)
        if isinstance(reason, CodedError):
            cause = reason.code
        self.update(state=state, reason=str(reason), cause=cause)

    def event(
        self, code: str, text: str, level: Level = "info", pose_index: int | None = None, /, **values: Value
    ) -> None:
        """Tells people, log and recording; `code` and `values` are for programs."""
        text = text if len(text) <= EVENT_TEXT_LIMIT else text[: EVENT_TEXT_LIMIT - 1] + "…"
        event = Event(time.time_ns(), level, text, pose_index, code, values)
        pose = f"pose {pose_index + 1}: " if pose_index is not None else ""
        log.log(getattr(logging, level.upper()), "%s%s", pose, text)
        self.update(events=(*self.status.events, event)[-EVENTS_KEPT:])
        for listener in self._listeners:
            listener(event)

    def problem(
        self, error: Exception, level: Level = "warning", pose_index: int | None = None, said: str = "{}"
    ) -> None:
        """Tells of an error; `said` puts its text into a sentence."""
        code, values = (error.code, error.values) if isinstance(error, CodedError) else ("internal", {})
        self.event(code, said.format(error), level, pose_index, **values)
