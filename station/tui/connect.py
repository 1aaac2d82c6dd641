"""Connect: what a capture needs, what is there, and the remedy for what is not, beside the live picture."""

from __future__ import annotations

from collections.abc import Sequence

from textual.app import ComposeResult
from textual.containers import Horizontal, VerticalScroll
from textual.content import Content

from station.protocol.verbs import Check
from station.tui.frame import Line
from station.tui.screen import Box, StationScreen
from station.tui.widgets.preview import PreviewPane
from station.tui.words import Mark, dim, hanging, lines, mark

AGAIN_S = 5.0
STATES: dict[str, tuple[Mark, str]] = {
    "ok": ("done", "ready"),
    "warning": ("look", "look"),
    "failed": ("failed", "MISSING"),
    "skipped": ("todo", "no need"),
}


def checklist_text(checks: Sequence[Check], width: int) -> Content:
    """Draw the checklist: what is missing first, its remedy below it."""
    if not checks:
        return Content("checking …")

    rows = []
    for check in sorted(checks, key=lambda check: ("failed", "warning", "ok", "skipped").index(check.state)):
        kind, word = STATES[check.state]
        style = "bold $strong" if check.state in ("failed", "warning") else "$foreground"
        rows.append(
            mark(kind, f"{word:<9}")
            + Content.styled(f"{check.name:<15}", style)
            + dim(hanging(check.text, width, 26))
        )
        if check.remedy and check.state != "ok":
            rows.append(Content.styled(f"{'':11}→ {hanging(check.remedy, width, 13)}", "$foreground"))
    missing = any(check.state == "failed" for check in checks)
    end = (
        mark("look", "This list refreshes every few seconds.")
        if missing
        else mark("done", "Nothing is missing.")
    )
    return lines(*rows, Content(""), end)


class ConnectScreen(StationScreen):
    """The preflight check, looked at again while something is missing."""

    MODE, TIP = "connect", "What is missing, and its remedy"

    def on_mount(self) -> None:
        self.query_one("#checklist-scroll").border_title = "What a capture needs"
        self.set_interval(AGAIN_S, self.look_again)

    def body(self) -> ComposeResult:
        with Horizontal(id="connect"):
            with VerticalScroll(id="checklist-scroll", classes="panel"):
                yield Line(lambda known, width: checklist_text(known.checks, width), id="checklist")
            with Box("Camera", id="connect-picture", below="o: in a browser"):
                yield PreviewPane(id="preview")

    async def on_screen_resume(self) -> None:
        await self.app.run_action("look_at_checks")

    async def look_again(self) -> None:
        """Check again while something is missing, whatever is shown; an arm at work is left in peace."""
        known = self.known
        if known.missing is not None and not known.old and not known.works:
            await self.app.run_action("look_at_checks")
