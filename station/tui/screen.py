"""What every screen has: the bar on top, the reason below it, the keys at the bottom."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from textual.app import ComposeResult
from textual.screen import Screen

from station.cell.status import StationStatus
from station.tui.widgets.bar import ReasonLine, StatusBar
from station.tui.widgets.keys import Keys

if TYPE_CHECKING:
    from station.tui.app import StationApp


class StationScreen(Screen[None]):
    """A full screen of the station; `body` is what differs."""

    AUTO_FOCUS = ""
    HORIZONTAL_BREAKPOINTS = [(0, "-narrow"), (120, "-wide")]  # noqa: RUF012  (as textual declares it)
    VERTICAL_BREAKPOINTS = [(0, "-short"), (32, "-tall")]  # noqa: RUF012

    def compose(self) -> ComposeResult:
        yield StatusBar(id="bar")
        yield ReasonLine(id="reason")
        yield from self.body()
        yield Keys(self.station.common_actions())

    @property
    def station(self) -> StationApp:
        return cast("StationApp", self.app)

    def on_screen_resume(self) -> None:
        for status in (self.station.known, self.station.status):  # it may be the first time, or long ago
            self.show(status)
        self.doubt(self.station.trouble, self.station.silent_s)
        self.say_busy(self.station.busy)

    def body(self) -> ComposeResult:
        yield from ()

    def show(self, status: StationStatus | None) -> None:
        """Hands the newest status to every part that shows some of it."""
        for part in self.query("StatusBar, ReasonLine, Panel, Events"):
            part.status = status  # type: ignore[attr-defined]

    def say_busy(self, words: str) -> None:
        """What the daemon is at work on for this screen; empty: nothing."""
        for line in self.query(ReasonLine):
            line.busy = words

    def doubt(self, trouble: str, silent_s: float | None) -> None:
        """Why what stands here is old (empty: it is not), and for how long the daemon has not answered."""
        self.set_class(bool(trouble), "-old")
        for bar in self.query(StatusBar):
            bar.silent_s = silent_s
        for line in self.query(ReasonLine):
            line.trouble = trouble
        for part in self.query("Panel, Preview"):
            part.old = bool(trouble)  # type: ignore[attr-defined]
