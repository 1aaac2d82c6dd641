"""Live: what the operator watches while the arm works."""

from __future__ import annotations

from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical

from station.tui.screen import StationScreen
from station.tui.widgets import panels
from station.tui.widgets.events import Events
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
