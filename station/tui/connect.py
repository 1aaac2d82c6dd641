"""Connect: what a capture needs, what is there, and the remedy for what is not, beside the live picture."""

from __future__ import annotations

import textwrap
from typing import ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.content import Content
from textual.widgets import Static

from station.protocol.states import RUNNING
from station.protocol.verbs import Check, Doctor
from station.tui.screen import Box, StationScreen
from station.tui.widgets.preview import PreviewPane
from station.tui.words import Mark, mark

AGAIN_S = 5.0
STATES: dict[str, tuple[Mark, str]] = {
    "ok": ("done", "ready"),
    "warning": ("look", "look"),
    "failed": ("failed", "MISSING"),
    "skipped": ("todo", "not used"),
}
READY = "Nothing is missing."
NOT_READY = "This list refreshes every few seconds."


def checklist_text(checks: list[Check], width: int) -> Content:
    """Draw the checklist: what is missing first, its remedy below it."""

    def hanging(text: str, indent: int) -> str:
        return f"\n{' ' * indent}".join(textwrap.wrap(text, max(20, width - indent)))

    rows = []
    for check in sorted(checks, key=lambda check: ("failed", "warning", "ok", "skipped").index(check.state)):
        kind, word = STATES[check.state]
        style = "bold $strong" if check.state in ("failed", "warning") else "$foreground"
        rows.append(
            mark(kind, f"{word:<9}")
            + Content.styled(f"{check.name:<15}", style)
            + Content.styled(hanging(check.text, 26), "$dim")
        )
        if check.remedy and check.state != "ok":
            rows.append(Content.styled(f"{'':11}→ {hanging(check.remedy, 13)}", "$foreground"))
    missing = any(check.state == "failed" for check in checks)
    end = mark("look", NOT_READY) if missing else mark("done", READY)
    return Content("\n").join([*rows, Content(""), end])


class ConnectScreen(StationScreen):
    """The preflight check, looked at again while something is missing."""

    MODE, TIP = "connect", "What is missing, and its remedy"
    HELP = "The same list as `station doctor`. It only looks: nothing moves and nothing is changed."
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("r", "refresh_checks", "Look again", tooltip="Look at every item again")
    ]

    def on_mount(self) -> None:
        self.query_one("#checklist-scroll").border_title = "What a capture needs"
        self.query_one("#checklist-scroll").focus()  # where much is missing, keys reach the end of it
        self.set_interval(AGAIN_S, self.look_again)

    def body(self) -> ComposeResult:
        with Horizontal(id="connect"):
            with VerticalScroll(id="checklist-scroll", classes="panel"):
                yield Static("checking …", id="checklist")
            with Box("Camera", id="connect-picture"):
                yield PreviewPane(id="preview")

    def on_screen_resume(self) -> None:
        super().on_screen_resume()
        self.action_refresh_checks()

    @work(exclusive=True, exit_on_error=False)
    async def action_refresh_checks(self) -> None:
        answer = await self.desk.ask(Doctor())
        if answer is None:
            return
        self.desk.checks = tuple(answer)
        checklist = self.query_one("#checklist", Static)
        checklist.update(checklist_text(answer, checklist.size.width))
        self.show(self.desk.known())

    def look_again(self) -> None:
        """Check again while something is missing, whatever is shown; an arm at work is left in peace."""
        known = self.desk.known()
        if known.missing is None or known.status is None or known.silent_s is not None:
            return
        if known.status.state not in RUNNING:
            self.action_refresh_checks()
