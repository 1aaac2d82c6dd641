"""A full screen of the station under the frame, and its tables."""

from __future__ import annotations

from typing import ClassVar, cast

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Container
from textual.widgets import DataTable

from station.tui.frame import Frame, Framed, Keys
from station.tui.results import ResultsDesk
from station.tui.task import Known


class StationScreen(Framed[None]):
    """One screen; `body` is what differs."""

    MODE: ClassVar[str] = ""
    """Its step of the task, or its name."""
    NAME: ClassVar[str] = ""

    def compose(self) -> ComposeResult:
        yield Frame(self.NAME, self.MODE)
        with Container(id="content"):
            yield from self.body()
        yield Keys(self.NAME.lower())

    @property
    def desk(self) -> ResultsDesk:
        return cast(ResultsDesk, self.app)

    def body(self) -> ComposeResult:
        yield from ()

    def show(self, known: Known) -> None:
        self.set_class(bool(known.trouble) or known.silent_s is not None, "-old")
        super().show(known)


class Rows(DataTable[object]):
    """A table of whole rows: one is marked, Home and End mark the first and the last."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("home", "scroll_top", show=False),
        Binding("end", "scroll_bottom", show=False),
    ]

    def __init__(self, *, id: str) -> None:
        super().__init__(id=id, cursor_type="row")
