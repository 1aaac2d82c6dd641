"""Live: what the operator watches while the arm works. Log: everything that was said meanwhile."""

from __future__ import annotations

from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.widgets import RichLog

from station.cell.status import Event, StationStatus
from station.tui.screen import StationScreen
from station.tui.widgets import panels
from station.tui.widgets.events import Events, event_text
from station.tui.widgets.preview import Preview
from station.tui.words import POSE_MARKS


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
                yield Preview(id="preview")
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
