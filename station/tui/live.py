"""Live: what the operator watches while the arm works."""

from __future__ import annotations

from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.screen import Screen
from textual.widgets import Footer

from station.status import StationStatus
from station.tui.widgets import panels
from station.tui.widgets.bar import ReasonLine, StatusBar
from station.tui.widgets.events import Events
from station.tui.widgets.preview import Preview


class LiveScreen(Screen[None]):
    """Camera, quality, progress on the left; devices, poses, estimate on the right; events below."""

    HELP = "The running capture. F5 asks before the arm moves; F12 stops it at once, in every screen."

    def compose(self) -> ComposeResult:
        yield StatusBar(id="bar")
        yield ReasonLine(id="reason")
        with Horizontal(id="live"):
            with Vertical(id="live-left"):
                yield Preview(id="preview")
                yield panels.Panel("Detection", panels.detection_lines, id="detection")
                yield panels.Panel("Pose", panels.progress_lines, id="progress")
            with Vertical(id="live-right"):
                yield panels.Panel("Devices", panels.device_lines, id="devices")
                yield panels.Panel("Poses", panels.pose_map_lines, id="poses")
                yield panels.Panel("Estimate (not final)", panels.estimate_lines, id="estimate")
                yield panels.Panel("Robot", panels.robot_lines, id="robot")
        yield Events()
        yield Footer()

    def show(self, status: StationStatus | None) -> None:
        """Hands the newest status to every part that shows some of it."""
        for part in self.query("StatusBar, ReasonLine, Panel, Events"):
            part.status = status  # type: ignore[attr-defined]
