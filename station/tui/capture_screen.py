"""Capture: what the operator watches while the arm works."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical

from station.cell.status import StationState
from station.protocol import verbs
from station.protocol.states import LATCHED, RUNNING
from station.tui.capture_panels import coverage_lines, error_lines, quality_line
from station.tui.frame import Line
from station.tui.progress import LEGEND, progress_lines
from station.tui.screen import Box, Panel, StationScreen
from station.tui.stopped import Stopped
from station.tui.task import Known
from station.tui.widgets.preview import PreviewPane

BACK = "Backspace takes the last view back"
ERROR_LEGEND = "mm, log axis, by pose: █ by images  : planned"


class CaptureScreen(StationScreen):
    """The camera's picture as large as it can be; progress, error and coverage beside it."""

    MODE, TIP = "capture", "The running capture"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("backspace", "take_back", "Take back", tooltip="By hand: take the last view back"),
    ]

    def body(self) -> ComposeResult:
        with Horizontal(id="live"):
            with Box("Camera", id="picture", below="+ found corners  o: in a browser"):
                yield PreviewPane(id="preview")
                yield Line(lambda known, _: quality_line(known.shown.detection), id="quality")
            with Vertical(id="live-right"):
                yield Panel("Poses", progress_lines, id="progress", below=LEGEND)
                yield Panel("Placed-point error", error_lines, id="error", below=ERROR_LEGEND)
                yield Panel("Where the board was seen", coverage_lines, id="coverage", below="images")
        yield Stopped(id="stopped")

    def action_take_back(self) -> None:
        """Take back the last view that counts; only by hand."""
        status = self.known.shown
        counting = [pose.index for pose in status.session.poses if pose.counts]
        if status.state is StationState.FREE_DRIVE and counting:
            self.ask(verbs.Skip(counting[-1]))

    def show(self, known: Known) -> None:
        status, session = known.shown, known.shown.session
        by_hand = known.hand_guided
        progress = self.query_one("#progress", Panel)
        progress.border_subtitle = BACK if by_hand else LEGEND
        self.query_one(PreviewPane).wanted = status.guidance.outline
        progress.heading = "By hand" if by_hand else "Poses"
        if not by_hand and session.current is not None and status.state in RUNNING:
            progress.heading = f"Pose {session.current + 1} of {len(session.poses)}"
        error = self.query_one("#error", Panel)
        error.heading = "Drift check" if session.check else "Placed-point error"
        error.border_subtitle = "" if session.check else ERROR_LEGEND
        self.query_one("#picture").border_title = (
            f"Camera  {status.camera.model}"
            if status.camera.connected or status.source == "playback"
            else "Camera: not connected"
        )
        self.query_one("#live").set_class(status.state in LATCHED, "-dimmed")
        self.query_one(Stopped).show(known)
        super().show(known)
