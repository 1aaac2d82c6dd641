"""Sessions: what was recorded; solve, recover, or watch any of them again."""

from __future__ import annotations

from typing import ClassVar, Literal

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.content import Content
from textual.message import Message
from textual.widgets import Static

from calibrate.files.formatting import figures
from station.cell.session_folder import SessionSummary
from station.operate.drift_check import POSES
from station.tui.drift import drift_lines
from station.tui.installed import Kept, Past
from station.tui.screen import Box, Panel, Rows, StationScreen
from station.tui.task import Known
from station.tui.words import UNKNOWN, facts, lines, mark, size

DRIFT = f"Drift check: capture {POSES} poses in place of the loaded plan (asks)"
NO_SESSION = "No session is recorded yet: 2 then n makes a plan, F5 shows its path and asks."
COLUMNS = ("session", "what became of it", "verdict", "predicted", "held-out", "views")


SessionWork = Literal["solve", "show", "check", "recover"]


class SessionWish(Message):
    """A wish to do something with a recorded session."""

    def __init__(self, what: SessionWork, session: SessionSummary) -> None:
        super().__init__()
        self.what, self.session = what, session


class SessionsScreen(StationScreen):
    """Past recordings and their calibrations."""

    MODE, TIP = "sessions", "Past recordings"
    LOOK = "look_at_sessions"
    HELP = (
        "Past recordings. Solving runs in its own process; the daemon and a running capture go on. Home and "
        "End go to the newest and the oldest."
    )
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f9", "act('solve')", "Solve", tooltip="Solve this recording again, outside the daemon"),
        Binding("v", "act('show')", "Result", tooltip="Show this session's calibration; so does Enter"),
        Binding("k", "act('check')", "Check", tooltip="Drift check on the views of this recording"),
        Binding("d", "app.drift_check", "Drift", tooltip=DRIFT),
        Binding("c", "act('recover')", "Recover", tooltip="Rebuild an unfinished recording"),
    ]

    _past = Past()
    """What the table shows."""

    def body(self) -> ComposeResult:
        yield Static(NO_SESSION, id="sessions-none")
        with Horizontal(id="sessions"):
            with Box("Sessions", id="sessions-box"):
                yield Rows(*COLUMNS, id="sessions-table")
            with Vertical(id="sessions-right"):
                yield Panel(
                    "Drift of the installed calibration", self._drift, id="drift", below="mm over time"
                )
                yield Panel("Highlighted", self._highlighted, id="highlighted")

    def show(self, known: Known) -> None:
        super().show(known)
        past = known.past
        if past is None or past is self._past:
            return
        at = self._highlighted_one()
        self._past = past
        self.query_one("#sessions-none").display = not past.sessions
        self.query_one("#sessions").display = bool(past.sessions)
        self.table.show([_row(kept) for kept in past.sessions])
        names = [kept.session.name for kept in past.sessions]
        self.table.move_cursor(row=names.index(at.session.name) if at and at.session.name in names else 0)
        self.draw_panels(known)

    def _highlighted_one(self) -> Kept | None:
        sessions, line = self._past.sessions, self.table.cursor_row
        return sessions[line] if line < len(sessions) else None

    def _drift(self, known: Known, width: int, height: int) -> Content:
        return drift_lines(self._past.drift, width, height)

    def _highlighted(self, known: Known, width: int, height: int) -> Content:
        if (kept := self._highlighted_one()) is None:
            return Content()
        session, found = kept.session, kept.calibration
        state = mark("done", "finished") if session.sealed else mark("look", "UNFINISHED: c recovers it")
        rows = [
            Content.styled(session.name, "bold $strong")
            + Content.styled(f"  {session.source.upper()}" if session.source != "real" else "", "$sim"),
            facts(("", str(session.views), "views"), ("", size(session.bytes), "")) + Content("   ") + state,
        ]
        if found is not None:
            rows += [
                Content(
                    f"{found.robot.model} {found.robot.serial}, {found.camera.model} {found.camera.serial}"
                ),
                mark(
                    "failed" if found.quality.failed else "done",
                    f"{figures(found)['gates'].value} gates passed",
                ),
            ]
        keys = "Enter result  " * bool(session.calibration) + "F9 solve  k drift check on it"
        return lines(*rows, Content(""), Content.styled(keys, "$accent"))

    def action_act(self, what: SessionWork) -> None:
        """Do what a key says with the highlighted session."""
        if (kept := self._highlighted_one()) is None:
            self.notify(NO_SESSION)
            return
        session = kept.session
        if what == "solve" and not session.sealed:
            self.notify("This recording was never finished: press c to recover it first.")
        elif what == "show" and not session.calibration:
            self.notify("Not solved yet: F9 solves it.")
        else:
            self.post_message(SessionWish(what, session))

    def on_data_table_row_selected(self) -> None:
        """Enter on a session: what it gave."""
        self.action_act("show")


def _row(kept: Kept) -> tuple[Content, ...]:
    session, found, check = kept.session, kept.calibration, kept.check
    predicted = held = UNKNOWN
    became, verdict = kept.word, mark("todo", "not solved")
    if found is not None:
        quality = found.quality
        predicted = UNKNOWN if quality.predicted_error_mm is None else f"± {quality.predicted_error_mm:.2f}"
        held = UNKNOWN if quality.holdout is None else f"{1000 * quality.holdout.e_t_m:.2f}"
        verdict = mark("failed" if found.verdict == "FAIL" else "done", found.verdict)
        became = became or "solved, not installed"
    elif check is not None:
        verdict = mark("done" if check.passed else "failed", "PASS" if check.passed else "FAIL")
        became = "drift check"
    if not session.sealed:
        verdict, became = mark("look", "UNFINISHED"), "c recovers it"
    now = became.startswith("INSTALLED")
    style = "bold $accent" if now else "$foreground"
    return (
        Content.styled(session.name, "$foreground"),
        Content.styled(("● " if now else "") + became, style),
        verdict,
        facts(("", f"{predicted:>6}", "mm")),
        facts(("", f"{held:>5}", "mm")),
        Content.styled(f"{session.views:>4}", "$foreground"),
    )
