"""Checklist: what a capture needs, what is there, and the remedy for what is not."""

from __future__ import annotations

from typing import ClassVar

from rich.console import Group
from rich.table import Table
from rich.text import Text
from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import Static

from station.protocol.verbs import Check, Doctor
from station.tui.screen import StationScreen

WORDS = {"ok": "ok", "warning": "WARN", "failed": "MISSING", "skipped": "-"}

AGAIN_S = 5.0
READY = "\nNothing is missing. 1 shows the cell, 2 then n makes a plan, F5 asks before the arm moves."
NOT_READY = "\nSomething is missing: its remedy stands beside it. This list looks again every few seconds."


def checklist_table(checks: list[Check]) -> Table:
    """One row a check; the remedy stands below what is missing."""
    table = Table(box=None, expand=True, padding=(0, 1))
    for title, width in (("", 8), ("what", 18), ("found", None)):
        table.add_column(title, width=width)
    for check in checks:
        text = Text(check.text)
        if check.remedy and check.state != "ok":
            text.append(f"\n→ {check.remedy}", style="bold")
        table.add_row(WORDS[check.state], check.name, text)
    return table


class ChecklistScreen(StationScreen):
    """The preflight check, looked at again while something is missing."""

    HELP = "The same list as `station doctor`. It only looks: nothing moves and nothing is changed."
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("r", "refresh_checks", "Check again", tooltip="Look at every item again")
    ]

    def __init__(self) -> None:
        super().__init__()
        self._missing = True

    def on_mount(self) -> None:
        self.query_one("#checklist-scroll").focus()  # where much is missing, keys reach the end of it
        self.set_interval(AGAIN_S, self.look_again)

    def body(self) -> ComposeResult:
        with VerticalScroll(id="checklist-scroll"):
            yield Static("checking …", id="checklist")

    def on_screen_resume(self) -> None:
        super().on_screen_resume()
        self.action_refresh_checks()

    @work(exclusive=True, exit_on_error=False)
    async def action_refresh_checks(self) -> None:
        answer = await self.desk.ask(Doctor())
        if answer is None:
            return
        self._missing = any(check.state == "failed" for check in answer)
        words = NOT_READY if self._missing else READY
        self.query_one("#checklist", Static).update(Group(checklist_table(answer), Text(words, style="bold")))

    def look_again(self) -> None:
        """Check again while something is missing; what is there is left in peace."""
        if self._missing and self.is_current:
            self.action_refresh_checks()
