"""Sessions: what was recorded; solve, recover, or watch any of them again."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.content import Content
from textual.widgets import Static

from calibrate.quality.checks import CheckEntry, read_checks
from station.cell.session_folder import SessionSummary
from station.operate.drift_check import POSES
from station.protocol.verbs import Sessions
from station.tui.installed import Installed, drift_history, read_installed, readable
from station.tui.replay import ReplayLink
from station.tui.replay_screen import WATCHABLE, ReplayScreen
from station.tui.result import drift_lines
from station.tui.screen import Box, Panel, Rows, StationScreen
from station.tui.task import Known
from station.tui.words import UNKNOWN, facts, mark, size

DRIFT = f"Drift check: capture {POSES} poses in place of the loaded plan (asks)"
NO_SESSION = "No session is recorded yet: 2 then n makes a plan, F5 shows its path and asks."
COLUMNS = ("session", "what became of it", "verdict", "predicted", "held-out", "views")


class SessionsScreen(StationScreen):
    """Past recordings and their calibrations."""

    MODE, TIP = "sessions", "Past recordings"
    HELP = (
        "Past recordings. Solving runs in its own process; the daemon and a running capture go on. Home and "
        "End go to the newest and the oldest."
    )
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f9", "act('solve')", "Solve", tooltip="Solve this recording again, outside the daemon"),
        Binding("v", "act('result')", "Result", tooltip="Show this session's calibration; so does Enter"),
        Binding("w", "act('watch')", "Watch", tooltip="Play this recording in the live screen"),
        Binding("k", "act('check')", "Check", tooltip="Drift check on the views of this recording"),
        Binding("d", "drift", "Drift", tooltip=DRIFT),
        Binding("c", "act('recover')", "Recover", tooltip="Rebuild an unfinished recording"),
    ]

    def __init__(self) -> None:
        super().__init__()
        self._sessions: list[SessionSummary] = []
        self._checks: list[CheckEntry] = []

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

    def on_mount(self) -> None:
        self.table.focus()
        self.watch(self.desk, "looked", self._looked, init=False)

    def on_screen_resume(self) -> None:
        super().on_screen_resume()
        self.fetch()

    def _looked(self) -> None:
        """Another screen or a shell has recorded, solved or installed."""
        if self.is_current:
            self.fetch()

    @property
    def table(self) -> Rows:
        return self.query_one(Rows)

    @work(exclusive=True, group="fetch", exit_on_error=False)
    async def fetch(self) -> None:
        root = self.desk.root
        answer = await self.desk.ask(Sessions())
        if answer is None:
            self.desk.forget_look()
            return  # why was said; what was known stays
        self._fill(answer, *(await asyncio.to_thread(_beside, root, self.desk.camera, answer)))

    def _fill(
        self, sessions: list[SessionSummary], rows: list[tuple[Content, ...]], checks: list[CheckEntry]
    ) -> None:
        at = self._sessions[self.table.cursor_row].name if self._sessions else ""
        self._sessions, self._checks = sessions, checks
        self.query_one("#sessions-none").display = not sessions
        self.query_one("#sessions").display = bool(sessions)
        self.table.show(rows)
        names = [session.name for session in sessions]
        self.table.move_cursor(row=names.index(at) if at in names else 0)
        self.draw_panels(self.desk.known())

    def on_data_table_row_highlighted(self) -> None:
        self.draw_panels(self.desk.known())

    def _drift(self, known: Known, width: int, height: int) -> Content:
        return drift_lines(self._checks, width, height)

    def _highlighted(self, known: Known, width: int, height: int) -> Content:
        if not self.table.row_count or self.table.cursor_row >= len(self._sessions):
            return Content()
        session = self._sessions[self.table.cursor_row]
        state = mark("done", "finished") if session.sealed else mark("look", "UNFINISHED: c recovers it")
        rows = [
            Content.styled(session.name, "bold $strong")
            + Content.styled(f"  {session.source.upper()}" if session.source != "real" else "", "$sim"),
            facts(("", str(session.views), "views"), ("", size(session.bytes), "")) + Content("   ") + state,
        ]
        found = readable(Path(session.calibration)) if session.calibration else None
        if found is not None:
            gates = found.quality.gates
            rows += [
                Content(
                    f"{found.robot.model} {found.robot.serial}, {found.camera.model} {found.camera.serial}"
                ),
                mark(
                    "failed" if found.quality.failed else "done",
                    f"{sum(g.passed for g in gates)} of {len(gates)} gates passed",
                ),
            ]
        keys = "Enter result  " * bool(session.calibration) + "F9 solve  w play  k drift check on it"
        return Content("\n").join([*rows, Content(""), Content.styled(keys, "$accent")])

    async def action_act(self, what: str) -> None:
        """Do what a key says with the highlighted session."""
        if not self._sessions:
            self.notify(NO_SESSION)
            return
        session = self._sessions[self.table.cursor_row]
        match what:
            case "solve" if not session.sealed:
                self.notify("This recording was never finished: press c to recover it first.")
            case "solve":
                self.desk.solve(session.recording, session.folder)
            case "result" if not session.calibration:
                self.notify("Not solved yet: F9 solves it.")
            case "result":
                await self.desk.show_result(session.calibration)
            case "watch":
                self.play(session)
            case "check":
                self.desk.check(session.recording, session.folder)
            case "recover":
                self.desk.recover(session.folder)

    async def on_data_table_row_selected(self) -> None:
        """Enter on a session: what it gave."""
        await self.action_act("result")

    def action_drift(self) -> None:
        self.desk.drift_check()

    @work(exclusive=True, group="job", exit_on_error=False)
    async def play(self, session: SessionSummary) -> None:
        status = self.desk.status
        if status is not None and status.state not in WATCHABLE:
            self.notify(f"The cell is {status.state.value}: finish that first, then look at old recordings.")
            return
        link = await self.desk.attempt(asyncio.to_thread(ReplayLink, Path(session.folder)))
        if link is not None:
            await self.app.push_screen(ReplayScreen(link))


def _beside(
    root: Path | None, camera: str, sessions: list[SessionSummary]
) -> tuple[list[tuple[Content, ...]], list[CheckEntry]]:
    """A row for each session, and drift checks of what is installed; reads files, for a thread."""
    if root is None:
        return [_row(session, Installed(), {}) for session in sessions], []
    installed = read_installed(root, camera)
    judged = {check.recording: check for check in read_checks(root, camera)}
    return [_row(session, installed, judged) for session in sessions], drift_history(root, camera)


def _row(session: SessionSummary, installed: Installed, judged: dict[str, CheckEntry]) -> tuple[Content, ...]:
    found = readable(Path(session.calibration)) if session.calibration else None
    predicted = held = UNKNOWN
    became, verdict = installed.word(session.name), mark("todo", "not solved")
    if found is not None:
        quality = found.quality
        predicted = UNKNOWN if quality.predicted_error_mm is None else f"± {quality.predicted_error_mm:.2f}"
        held = UNKNOWN if quality.holdout is None else f"{1000 * quality.holdout.e_t_m:.2f}"
        verdict = mark("failed" if found.verdict == "FAIL" else "done", found.verdict)
        became = became or "solved, not installed"
    elif (check := judged.get(session.name)) is not None:
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
