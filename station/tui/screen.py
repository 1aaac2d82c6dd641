"""The frame of every screen: the bar on top, the reason below it, the keys at the bottom."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from typing import ClassVar, cast

from textual.app import ComposeResult
from textual.binding import ActiveBinding, Binding, BindingType
from textual.containers import HorizontalGroup
from textual.screen import Screen
from textual.widgets import DataTable, Footer
from textual.widgets._footer import FooterKey, FooterLabel

from station.cell.status import StationStatus
from station.tui.results import ResultsDesk
from station.tui.widgets.bar import ReasonLine, StatusBar


class Keys(Footer):
    """The keys at the bottom: this screen's own in a line, those of every screen below.

    `common`: the actions of every screen. STOP's key stands in the bar, always.
    """

    def __init__(self, common: Iterable[str]) -> None:
        super().__init__(compact=True)
        self._common = set(common)

    def compose(self) -> ComposeResult:
        if not self.app.screen_stack:  # between two modes, or while the app closes: it is asked for again
            return
        shown = [active for active in self.screen.active_bindings.values() if active.binding.show]
        for common in (False, True):
            line = [active for active in shown if (active.binding.action in self._common) is common]
            if line:
                with HorizontalGroup():
                    yield from self._line(line)

    def _line(self, line: list[ActiveBinding]) -> ComposeResult:
        for group, alike in groupby(line, lambda active: active.binding.group):
            for _, binding, enabled, tooltip in alike:
                yield FooterKey(
                    binding.key,
                    self.app.get_key_display(binding),
                    "" if group else binding.description,
                    binding.action,
                    disabled=not enabled,
                    tooltip=tooltip or binding.description,
                    classes="-grouped" if group else "",
                ).data_bind(compact=Footer.compact)
            if group:
                yield FooterLabel(group.description)


class StationScreen(Screen[None]):
    """A full screen of the station; `body` is what differs."""

    AUTO_FOCUS = ""
    HORIZONTAL_BREAKPOINTS = [(0, "-narrow"), (120, "-wide")]  # noqa: RUF012  (as textual declares it)
    VERTICAL_BREAKPOINTS = [(0, "-short"), (32, "-tall")]  # noqa: RUF012

    def compose(self) -> ComposeResult:
        yield StatusBar(id="bar")
        yield ReasonLine(id="reason")
        yield from self.body()
        yield Keys(self.desk.common_actions())

    @property
    def desk(self) -> ResultsDesk:
        return cast(ResultsDesk, self.app)

    def on_screen_resume(self) -> None:
        for status in (self.desk.known, self.desk.status):  # it may be the first time, or long ago
            self.show(status)
        self.doubt(self.desk.trouble, self.desk.silent_s)
        self.say_busy(self.desk.busy)

    def body(self) -> ComposeResult:
        yield from ()

    def show(self, status: StationStatus | None) -> None:
        """Hands the newest status to every part that shows some of it."""
        for part in self.query("StatusBar, ReasonLine, Panel, Events"):
            part.status = status  # type: ignore[attr-defined]

    def say_busy(self, words: str) -> None:
        """Say what the daemon is at work on for this screen; empty: nothing."""
        for line in self.query(ReasonLine):
            line.busy = words

    def doubt(self, trouble: str, silent_s: float | None) -> None:
        """Say why the screen is old (empty: it is not), and for how long the daemon has not answered."""
        self.set_class(bool(trouble), "-old")
        for bar in self.query(StatusBar):
            bar.silent_s = silent_s
        for line in self.query(ReasonLine):
            line.trouble = trouble
        for part in self.query("Panel, PreviewPane"):
            part.old = bool(trouble)  # type: ignore[attr-defined]


class Rows(DataTable[str]):
    """A table of whole rows: one is marked, Home and End mark the first and the last."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("home", "scroll_top", show=False),
        Binding("end", "scroll_bottom", show=False),
    ]

    def __init__(self, *, id: str) -> None:
        super().__init__(id=id, cursor_type="row", zebra_stripes=True)
