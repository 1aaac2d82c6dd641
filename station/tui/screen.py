"""What every screen has: the bar on top, the reason below it, the keys at the bottom."""

from __future__ import annotations

from textual.app import ComposeResult
from textual.screen import Screen
from textual.widgets import Footer

from station.status import StationStatus
from station.tui.widgets.bar import ReasonLine, StatusBar


class StationScreen(Screen[None]):
    """A full screen of the station; `body` is what differs."""

    AUTO_FOCUS = ""
    HORIZONTAL_BREAKPOINTS = [(0, "-narrow"), (110, "-wide")]  # noqa: RUF012  (as textual declares it)
    VERTICAL_BREAKPOINTS = [(0, "-short"), (32, "-tall")]  # noqa: RUF012

    def compose(self) -> ComposeResult:
        yield StatusBar(id="bar")
        yield ReasonLine(id="reason")
        yield from self.body()
        yield Footer()

    def on_screen_resume(self) -> None:
        self.show(self.app.status)  # type: ignore[attr-defined]

    def body(self) -> ComposeResult:
        yield from ()

    def show(self, status: StationStatus | None) -> None:
        """Hands the newest status to every part that shows some of it."""
        for part in self.query("StatusBar, ReasonLine, Panel, Events"):
            part.status = status  # type: ignore[attr-defined]
