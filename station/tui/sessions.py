"""Sessions: what was recorded; solve, recover or check any of them."""

from __future__ import annotations

from typing import ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.content import Content
from textual.widgets import Static

from station.protocol.results import Kept
from station.tui.jobs import check_session, recover_session, solve_session
from station.tui.screen import Box, Rows, StationScreen
from station.tui.task import Known
from station.tui.words import VERDICTS, facts, mark

NO_SESSION = "No session is recorded yet: F5 plans one, shows its path and asks."
COLUMNS = ("session", "state", "verdict", "views", "placed-point error")


class SessionsScreen(StationScreen):
    """Past recordings and their calibrations."""

    MODE, TIP = "sessions", "Past recordings"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f9", "act('solve')", "Solve", tooltip="Solve this recording again, outside the daemon"),
        Binding("enter", "act('show')", "Result", show=False, tooltip="Show this session's calibration"),
        Binding("k", "act('check')", "Check", tooltip="Drift check on the views of this recording"),
        Binding("c", "act('recover')", "Recover", tooltip="Rebuild an unfinished recording"),
    ]

    _sessions: tuple[Kept, ...] | None = None
    """What the table shows."""

    def body(self) -> ComposeResult:
        yield Static(NO_SESSION, id="sessions-none")
        with Box("Sessions", id="sessions"):
            yield Rows(*COLUMNS, id="sessions-table")

    def show(self, known: Known) -> None:
        super().show(known)
        sessions = known.sessions
        if sessions is None or sessions is self._sessions:
            return
        at = self._highlighted()
        self._sessions = sessions
        self.query_one("#sessions-none").display = not sessions
        self.query_one("#sessions").display = bool(sessions)
        self.table.show([_row(kept) for kept in sessions])
        names = [kept.session.name for kept in sessions]
        self.table.move_cursor(row=names.index(at.session.name) if at and at.session.name in names else 0)

    def _highlighted(self) -> Kept | None:
        line = self.table.cursor_row
        return self._sessions[line] if self._sessions and line < len(self._sessions) else None

    @work(exclusive=True, group="job", exit_on_error=False)
    async def action_act(self, what: str) -> None:
        """Do what a key says with the highlighted session."""
        if (kept := self._highlighted()) is None:
            self.notify(NO_SESSION)
            return
        session, link = kept.session, self.link
        match what:
            case "solve" if not session.sealed:
                self.notify("This recording was never finished: press c to recover it first.")
            case "solve":
                await solve_session(link, session.recording, session.folder)
            case "show" if kept.check is not None:
                self.notify("A drift check has no result of its own: 4 shows what it judged.")
            case "show" if not session.calibration:
                self.notify("Not solved yet: F9 solves it.")
            case "show":
                await link.app.show_result(session.name)
            case "check":
                await check_session(link, session.recording, session.folder)
            case "recover":
                await recover_session(link, session.folder)

    def on_data_table_row_selected(self) -> None:
        """Show a session's result at Enter."""
        self.action_act("show")


def _row(kept: Kept) -> tuple[Content, ...]:
    session = kept.session
    check = kept.check
    error = Content()
    became, verdict = kept.word, mark("todo", "not solved")
    if kept.verdict is not None:
        error = facts(("", *kept.error))
        verdict = mark(VERDICTS[kept.verdict], kept.verdict)
        became = became or "solved, not installed"
    elif check is not None:
        verdict = mark("done" if check.passed else "failed", "PASS" if check.passed else "FAIL")
        became = "drift check"
    elif session.check:
        verdict, became = mark("todo", "k judges it"), "drift check"
    if not session.sealed:
        verdict, became = mark("look", "UNFINISHED"), "c recovers it"
    now = became.startswith("INSTALLED")
    style = "bold $accent" if now else "$foreground"
    return (
        Content.styled(session.name, "$foreground"),
        Content.styled(("● " if now else "") + became, style),
        verdict,
        Content.styled(f"{session.views:>4}", "$foreground"),
        error,
    )
