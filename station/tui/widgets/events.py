"""The event list: newest first, level as a word and not only as a colour."""

from __future__ import annotations

import re

from rich.text import Text
from textual.reactive import reactive
from textual.widgets import Static

from station.cell.status import Event, StationStatus
from station.tui.words import clock

_STYLES = {"debug": "dim", "info": "", "warning": "bold", "error": "bold reverse"}
_FOLDERS = re.compile(r"(?<!\S)/\S*/(?=[^/\s]+/[^/\s]+)")
"""Of an absolute path all but its last two names."""
_WORDS = {"debug": "", "info": "", "warning": "WARN ", "error": "ERROR "}


def event_text(event: Event, width: int = 0) -> Text:
    """`width`: cells of the line; where a path makes it longer, its last two names stand for it. 0: whole."""
    pose = "" if event.pose_index is None else f"pose {event.pose_index + 1} "
    when, said = clock(event.wall_ns), _WORDS[event.level] + pose + event.text
    if 0 < width <= len(when) + len(said):
        said = _FOLDERS.sub("…/", said)
    return Text.assemble((when, "dim"), " ", (said, _STYLES[event.level]))


class Events(Static):
    """As many of the newest events as fit."""

    status: reactive[StationStatus | None] = reactive(None)

    def __init__(self, *, id: str = "events") -> None:
        super().__init__(id=id, classes="panel")
        self.border_title = "Events"
        self._shown: tuple[int, tuple[Event, ...]] | None = None

    def on_resize(self) -> None:
        self.watch_status(self.status)

    def watch_status(self, status: StationStatus | None) -> None:
        if status is None:
            return  # what was said last stands there
        newest, width = status.events[-max(4, self.size.height) :], self.content_size.width
        if (width, newest) != self._shown:
            self._shown = width, newest
            text = Text("\n", no_wrap=True, overflow="ellipsis")
            self.update(text.join(event_text(event, width) for event in reversed(newest)), layout=False)
