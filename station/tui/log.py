"""Log: everything that was said, newest last, to scroll through."""

from __future__ import annotations

from textual.app import ComposeResult
from textual.widgets import RichLog

from station.cell.status import Event, StationStatus
from station.tui.screen import StationScreen
from station.tui.widgets.events import event_text


class LogScreen(StationScreen):
    HELP = "All events the daemon still holds; the same lines are in the journal and in the recording."

    def __init__(self) -> None:
        super().__init__()
        self._last: Event | None = None

    def body(self) -> ComposeResult:
        yield RichLog(id="log", wrap=True, max_lines=2000)

    def on_mount(self) -> None:
        self.query_one("#log", RichLog).focus()

    def show(self, status: StationStatus | None) -> None:
        super().show(status)
        events = () if status is None else status.events
        start = events.index(self._last) + 1 if self._last in events else 0
        if status is not None and status.playback and start == 0:  # it went back
            self.query_one("#log", RichLog).clear()
        for event in events[start:]:
            self.query_one("#log", RichLog).write(event_text(event))
            self._last = event
