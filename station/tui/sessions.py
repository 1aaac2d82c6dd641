"""Sessions: what was recorded; solve, recover, or watch any of them again."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.widgets import Static

from station.cell.session_folder import SessionSummary
from station.operate.drift_check import POSES
from station.protocol.states import RUNNING
from station.protocol.verbs import Sessions
from station.tui.installed import LOOK_S, Installed, Marks, marks, read_installed
from station.tui.replay import ReplayLink
from station.tui.replay_screen import WATCHABLE, ReplayScreen
from station.tui.screen import Rows, StationScreen
from station.tui.words import size

DRIFT = f"Drift check: capture {POSES} poses in place of the loaded plan (asks)"
NO_SESSION = "No session is recorded yet: 2 then n makes a plan, F5 shows its path and asks."
COLUMNS = ("session", "source", "views", "size", "state", "calibration")


class SessionsScreen(StationScreen):
    """Past recordings and their calibrations."""

    HELP = (
        "Past recordings. Solving runs in its own process; the daemon and a running capture go on. Home and "
        "End go to the newest and the oldest."
    )
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f9", "solve", "Solve", tooltip="Solve this recording again, outside the daemon"),
        Binding("v", "result", "Result", tooltip="Show this session's calibration; so does Enter"),
        Binding("w", "watch", "Watch", tooltip="Play this recording in the live screen"),
        Binding("k", "check", "Check", tooltip="Drift check on the views of this recording"),
        Binding("d", "drift", "Drift", tooltip=DRIFT),
        Binding("c", "recover", "Recover", tooltip="Rebuild an unfinished recording"),
    ]

    def __init__(self) -> None:
        super().__init__()
        self._sessions: list[SessionSummary] = []
        self._marks: Marks = frozenset()

    def body(self) -> ComposeResult:
        yield Static(NO_SESSION, id="sessions-none")
        yield Rows(id="sessions-table")

    def on_mount(self) -> None:
        self.table.add_columns(*COLUMNS)
        self.table.focus()
        self.set_interval(LOOK_S, self.look_again)

    def on_screen_resume(self) -> None:
        super().on_screen_resume()
        self.fetch()

    async def look_again(self) -> None:
        """Another screen or a shell may have solved or installed. A daemon at work is left in peace."""
        root, status = self.desk.root, self.desk.status
        if not self.is_current or root is None or status is None or status.state in RUNNING:
            return
        if await asyncio.to_thread(marks, root) != self._marks:
            self.fetch()

    @property
    def table(self) -> Rows:
        return self.query_one(Rows)

    @work(exclusive=True, group="fetch", exit_on_error=False)
    async def fetch(self) -> None:
        root = self.desk.root
        if root is not None:  # noted first: a slow answer must not be asked for again and again
            self._marks = await asyncio.to_thread(marks, root)
        answer = await self.desk.ask(Sessions())
        if answer is None:
            self._marks = frozenset()
            return  # why was said; what was known stays
        installed = (
            Installed() if root is None else await asyncio.to_thread(read_installed, root, self.desk.camera)
        )
        at = self._sessions[self.table.cursor_row].name if self._sessions else ""
        self._sessions = answer
        self.query_one("#sessions-none").display = not self._sessions
        self.table.clear()
        for session in self._sessions:
            self.table.add_row(
                session.name,
                session.source,
                str(session.views),
                size(session.bytes),
                "finished" if session.sealed else "UNFINISHED",
                installed.word(session.name) or ("solved" if session.calibration else "-"),
            )
        names = [session.name for session in self._sessions]
        self.table.move_cursor(row=names.index(at) if at in names else 0)

    def _selected(self) -> SessionSummary | None:
        if not self._sessions:
            self.notify(NO_SESSION)
            return None
        return self._sessions[self.table.cursor_row]

    def action_solve(self) -> None:
        if (session := self._selected()) is not None:
            if not session.sealed:
                self.notify("This recording was never finished: press c to recover it first.")
                return
            self.desk.solve(session.recording, session.folder)

    async def action_result(self) -> None:
        if (session := self._selected()) is not None:
            if not session.calibration:
                self.notify("Not solved yet: F9 solves it.")
                return
            await self.desk.show_result(session.calibration)

    async def on_data_table_row_selected(self) -> None:
        """Enter on a session: what it gave."""
        await self.action_result()

    def action_check(self) -> None:
        if (session := self._selected()) is not None:
            self.desk.check(session.recording, session.folder)

    def action_drift(self) -> None:
        self.desk.drift_check()

    @work(exclusive=True, group="job", exit_on_error=False)
    async def action_watch(self) -> None:
        session, status = self._selected(), self.desk.status
        if session is None:
            return
        if status is not None and status.state not in WATCHABLE:
            self.notify(f"The cell is {status.state.value}: finish that first, then look at old recordings.")
            return
        link = await self.desk.attempt(asyncio.to_thread(ReplayLink, Path(session.folder)))
        if link is not None:
            await self.app.push_screen(ReplayScreen(link))

    def action_recover(self) -> None:
        if (session := self._selected()) is not None:
            self.desk.recover(session.folder)
