"""A full screen of the station under the frame, its panels and its tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Container, Vertical
from textual.content import Content
from textual.widgets import DataTable, Footer

from station.protocol.client import ANSWER_S
from station.protocol.verbs import Verb
from station.tui.daemon_link import DaemonApp, DaemonLink
from station.tui.frame import Framed, Line
from station.tui.task import Known
from station.tui.widgets.preview import PreviewPane
from station.tui.words import rich_text


class Panel(Line):
    """A titled box of text."""

    def __init__(
        self, title: str, body: Callable[[Known, int, int], Content], *, id: str, below: str = ""
    ) -> None:
        """`body`: text from what is known, width and height. `below`: unit or keys, in the lower border."""
        super().__init__(lambda known, _: body(known, *self.content_size), id=id, classes="panel")
        self.border_title, self.border_subtitle = title, below
        self.heading = title
        """The title without `OLD`."""

    def show(self, known: Known) -> None:
        title = f"{self.heading}: OLD" if known.old else self.heading
        if self.border_title != title:
            self.border_title = title
        if known.status is not None and self.display:
            super().show(known)


class Box(Vertical):
    """A titled box of other widgets."""

    def __init__(self, title: str, *, id: str, below: str = "") -> None:
        super().__init__(id=id, classes="panel")
        self.border_title, self.border_subtitle = title, below


class Rows(DataTable[object]):
    """A table with a cursor on a whole row; Home and End go to the first and the last."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("home", "scroll_top", show=False),
        Binding("end", "scroll_bottom", show=False),
    ]

    def __init__(self, *columns: str, id: str) -> None:
        super().__init__(id=id, cursor_type="row")
        self.add_columns(*columns)
        self._cells: Sequence[tuple[Content, ...]] = ()
        self._texts: list[list[Text]] = []

    def on_mount(self) -> None:
        # A table keeps the colours that its texts had when they were given to it.
        self.app.theme_changed_signal.subscribe(self, lambda _: self.show(self._cells))

    def show(self, cells: Sequence[tuple[Content, ...]]) -> None:
        """Draw these rows, unless they stand there. The cursor stays on its line."""
        self._cells = cells
        texts = [[rich_text(cell) for cell in row] for row in cells]
        if texts == self._texts:
            return
        at, self._texts = self.cursor_row, texts
        self.clear()
        self.add_rows(texts)
        self.move_cursor(row=at)


class StationScreen(Framed[None]):
    """A screen below the frame; each has its own `body`."""

    AUTO_FOCUS = "Rows, #checklist-scroll, #log"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("f1", "app.help", "Help")]
    TIP: ClassVar[str] = ""
    """Purpose in a few words."""

    @property
    def link(self) -> DaemonLink:
        """The daemon, as every screen asks it."""
        assert isinstance(self.app, DaemonApp)
        return self.app.link

    def ask(self, verb: Verb[object], timeout_s: float = ANSWER_S) -> None:
        """Send a request to the daemon; a notice says why it was refused."""
        self.run_worker(self.link.ask(verb, timeout_s=timeout_s), group="command", exit_on_error=False)

    def compose(self) -> ComposeResult:
        yield self.frame()
        with Container(id="content"):
            yield from self.body()
        yield Footer(compact=True, show_command_palette=False)

    def body(self) -> ComposeResult:
        yield from ()

    def does_something(self, action: str) -> bool:
        return action != f"switch_mode('{self.MODE}')" and super().does_something(action)

    def on_screen_suspend(self) -> None:
        for preview in self.query(PreviewPane):
            preview.soften()

    def show(self, known: Known) -> None:
        self.set_class(known.old, "-old")
        for preview in self.query(PreviewPane):
            preview.old, preview.calm = known.blind, not known.works
        super().show(known)

    @property
    def table(self) -> Rows:
        """The one table of a screen that has one."""
        return self.query_one(Rows)

    def on_data_table_row_highlighted(self) -> None:
        self.show(self.known)
