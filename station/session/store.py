"""The one status of the station. Everything that changes it goes through here; watchers are told."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any, Literal

import msgspec

from station.cell.status import Event, StationState, StationStatus
from station.protocol.states import check_transition

log = logging.getLogger("station.events")

EVENTS_KEPT = 100
EVENT_TEXT_LIMIT = 400
Level = Literal["debug", "info", "warning", "error"]
_LEVELS = {"debug": logging.DEBUG, "info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


class StatusStore:
    """Holds the newest immutable snapshot. Only the event loop's thread may call it."""

    def __init__(self, status: StationStatus) -> None:
        self._status = status
        self._watchers: list[Callable[[], None]] = []
        self._listeners: list[Callable[[Event], None]] = []

    @property
    def status(self) -> StationStatus:
        return self._status

    @property
    def state(self) -> StationState:
        return self._status.state

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

    def update(self, **sections: Any) -> None:
        changed = {k: v for k, v in sections.items() if getattr(self._status, k) != v}
        if changed:
            self._status = msgspec.structs.replace(self._status, **changed)
            for watcher in list(self._watchers):
                try:
                    watcher()
                except Exception:  # who only looks on must not come between STOP and the arm
                    log.exception("a watcher of the status failed")

    def enter(self, state: StationState, reason: str = "") -> None:
        """Raises TransitionError for a step that the table does not allow."""
        if state is not self.state:
            check_transition(self.state, state)
        self.update(state=state, reason=reason)

    def event(self, text: str, level: Level = "info", pose_index: int | None = None) -> None:
        text = text if len(text) <= EVENT_TEXT_LIMIT else text[: EVENT_TEXT_LIMIT - 1] + "…"
        event = Event(time.time_ns(), level, text, pose_index)
        log.log(_LEVELS[level], "%s%s", f"pose {pose_index + 1}: " if pose_index is not None else "", text)
        self.update(events=(*self._status.events, event)[-EVENTS_KEPT:])
        for listener in self._listeners:
            listener(event)
