"""The event list: newest first, level as a word and not only as a colour."""

from __future__ import annotations

from rich.text import Text
from textual.reactive import reactive
from textual.widgets import Static

from station.status import Event, StationStatus
from station.tui.words import clock

_STYLES = {"debug": "dim", "info": "", "warning": "bold", "error": "bold reverse"}
_WORDS = {"debug": "", "info": "", "warning": "WARN ", "error": "ERROR "}


def event_text(event: Event) -> Text:
    pose = "" if event.pose_index is None else f"pose {event.pose_index + 1} "
    return Text.assemble(
        (clock(event.wall_ns), "dim"), " ", (_WORDS[event.level] + pose + event.text, _STYLES[event.level])
    )


class Events(Static):
    """As many of the newest events as fit."""

    status: reactive[StationStatus | None] = reactive(None)

    def __init__(self, *, id: str = "events") -> None:
        super().__init__(id=id, classes="panel")
        self.border_title = "Events"
        self._shown: tuple[Event, ...] | None = None

    def watch_status(self, status: StationStatus | None) -> None:
        if status is None:
            return  # what was said last stands there
        events = status.events
        newest = events[-max(4, self.size.height) :]
        if newest != self._shown:
            self._shown = newest
            text = Text("\n", no_wrap=True, overflow="ellipsis")
            self.update(text.join(event_text(event) for event in reversed(newest)), layout=False)
