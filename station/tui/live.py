"""Live: what the operator watches while the arm works. Log: everything that was said meanwhile."""

from __future__ import annotations

import re

from rich.text import Text
from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.reactive import reactive
from textual.widgets import RichLog, Static

from station.cell.status import Event, StationStatus
from station.tui.screen import StationScreen
from station.tui.widgets import panels
from station.tui.widgets.preview import PreviewPane
from station.tui.words import POSE_MARKS, clock

_STYLES = {"debug": "dim", "info": "", "warning": "bold", "error": "bold reverse"}
_FOLDERS = re.compile(r"(?<!\S)/\S*/(?=[^/\s]+/[^/\s]+)")
"""All but the last two names of an absolute path."""
_WORDS = {"debug": "", "info": "", "warning": "WARN ", "error": "ERROR "}


def event_text(event: Event, width: int = 0) -> Text:
    """`width`: cells of the line; where a path makes it longer, its last two names stand for it. 0: whole."""
    pose = "" if event.pose_index is None else f"pose {event.pose_index + 1} "
    when, said = clock(event.wall_ns), _WORDS[event.level] + pose + event.text
    if 0 < width <= len(when) + len(said):
        said = _FOLDERS.sub("…/", said)
    return Text.assemble((when, "dim"), " ", (said, _STYLES[event.level]))


class Events(Static):
    """The newest events, as many as fit."""

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


class LiveScreen(StationScreen):
    """Camera, quality, progress on the left; devices, poses, estimate on the right; events below."""

    HELP = (
        "The running capture. F5 asks before the arm moves; F12 stops it at once, in every screen. Poses: "
        + " ".join(f"{mark} {state}" for state, mark in POSE_MARKS.items())
        + "."
    )

    def body(self) -> ComposeResult:
        with Horizontal(id="live"):
            with Vertical(id="live-left"):
                yield PreviewPane(id="preview")
                yield panels.Panel("Detection", panels.detection_lines, id="detection")
                yield panels.Panel("Pose", panels.progress_lines, id="progress")
            with Vertical(id="live-right"):
                yield panels.Panel("Devices", panels.device_lines, id="devices")
                yield panels.Panel("Poses", panels.pose_map_lines, id="poses")
                yield panels.Panel("Image coverage", panels.coverage_lines, id="coverage")
                yield panels.Panel("Estimate (not final)", panels.estimate_lines, id="estimate", wrap=True)
                yield panels.Panel("Robot (mm, °)", panels.robot_lines, id="robot")
        yield Events()


class LogScreen(StationScreen):
    """All events, newest last, to scroll through."""

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
