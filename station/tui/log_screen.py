"""The event log: all that the daemon told."""

from __future__ import annotations

from datetime import datetime

from textual.app import ComposeResult
from textual.content import Content
from textual.theme import Theme
from textual.widgets import RichLog

from station.cell.status import Event
from station.tui.screen import StationScreen
from station.tui.task import Known
from station.tui.words import rich_text

_LEVELS = {"debug": ("", "$dim"), "info": ("", ""), "warning": ("▲ ", "$warn"), "error": ("✗ ", "bold $bad")}
"""Sign and style of an event."""


def event_text(event: Event) -> Content:
    clock = datetime.fromtimestamp(event.wall_ns / 1e9)
    pose = "" if event.pose_index is None else f"pose {event.pose_index + 1} "
    sign, style = _LEVELS[event.level]
    return Content.assemble((f"{clock:%H:%M:%S}", "$faint"), "  ", (sign + pose + event.text, style))


class LogScreen(StationScreen):
    """All events, newest last, to scroll through."""

    MODE, TIP = "log", "Event log"

    def __init__(self) -> None:
        super().__init__()
        self._last: Event | None = None

    def body(self) -> ComposeResult:
        yield RichLog(id="log", wrap=True, max_lines=2000, min_width=0)

    def on_mount(self) -> None:
        self.app.theme_changed_signal.subscribe(self, self._draw_again)

    def _draw_again(self, theme: Theme) -> None:
        """Write all lines in the colours of another theme."""
        self.query_one("#log", RichLog).clear()
        self._last = None
        self.show(self.known)

    def show(self, known: Known) -> None:
        super().show(known)
        status = known.status
        events = () if status is None else status.events
        start = events.index(self._last) + 1 if self._last in events else 0
        log = self.query_one("#log", RichLog)
        for event in events[start:]:
            line = rich_text(event_text(event))
            line.no_wrap = False
            log.write(line)
            self._last = event
