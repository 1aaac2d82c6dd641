"""Sessions: what was recorded; solve, recover, or watch any of them again."""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.widgets import Static

from station.operate.drift_check import POSES
from station.protocol.states import RUNNING
from station.tui.elsewhere import LOOK_S, Marks, marks
from station.tui.installed import Installed, read_installed
from station.tui.screen import StationScreen
from station.tui.widgets.rows import Rows
from station.tui.words import size

DRIFT = f"Take {POSES} pictures in place of the loaded plan: does the installed one still hold? (asks)"
NO_SESSION = "No session is recorded yet: 2 then n makes a plan, F5 shows its way and asks."
COLUMNS = ("session", "source", "views", "size", "state", "calibration")


def calibration_word(session: dict[str, Any], installed: Installed) -> str:
    return installed.word(str(session.get("name"))) or ("solved" if session.get("calibration") else "-")


class SessionsScreen(StationScreen):
    HELP = (
        "Past recordings. Solving runs in its own process; the daemon and a running capture go on. Home and "
        "End go to the newest and the oldest."
    )
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f9", "solve", "Solve", tooltip="Solve this recording again, outside the daemon"),
        Binding("v", "result", "Result", tooltip="Show this session's calibration; so does Enter"),
        Binding("w", "watch", "Watch", tooltip="Play this recording in the live screen"),
        Binding("k", "check", "Check", tooltip="Does the installed calibration still hold on this one?"),
        Binding("d", "drift", "Drift", tooltip=DRIFT),
        Binding("c", "recover", "Recover", tooltip="Rebuild an unfinished recording"),
    ]

    def __init__(self) -> None:
        super().__init__()
        self._sessions: list[dict[str, Any]] = []
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
        link, status = self.station.link, self.station.status
        if not self.is_current or link is None or link.root is None:
            return
        if status is None or status.state in RUNNING:
            return
        if await asyncio.to_thread(marks, link.root) != self._marks:
            self.fetch()

    @property
    def table(self) -> Rows:
        return self.query_one(Rows)

    @work(exclusive=True, group="fetch", exit_on_error=False)
    async def fetch(self) -> None:
        link = self.station.link
        root = None if link is None else link.root
        if root is not None:  # noted first: a slow answer must not be asked for again and again
            self._marks = await asyncio.to_thread(marks, root)
        answer = await self.station.ask("sessions")
        if answer is None:
            self._marks = frozenset()
            return  # why was said; what was known stays
        installed = Installed() if root is None else await asyncio.to_thread(read_installed, root)
        at = self._sessions[self.table.cursor_row]["name"] if self._sessions else ""
        self._sessions = list(answer)
        self.query_one("#sessions-none").display = not self._sessions
        self.table.clear()
        for session in self._sessions:
            self.table.add_row(
                str(session.get("name", "")),
                str(session.get("source", "")),
                str(session.get("views", "")),
                size(float(session.get("bytes", 0))),
                "sealed" if session.get("sealed") else "UNSEALED",
                calibration_word(session, installed),
            )
        names = [session.get("name", "") for session in self._sessions]
        self.table.move_cursor(row=names.index(at) if at in names else 0)

    def _selected(self) -> dict[str, Any] | None:
        if not self._sessions:
            self.notify(NO_SESSION)
            return None
        return self._sessions[self.table.cursor_row]

    def action_solve(self) -> None:
        if (session := self._selected()) is not None:
            if not session.get("sealed"):
                self.notify("This recording was never finished: press c to recover it first.")
                return
            self.station.solve(str(session["recording"]), str(session["folder"]))

    async def action_result(self) -> None:
        if (session := self._selected()) is not None:
            if not session.get("calibration"):
                self.notify("Not solved yet: F9 solves it.")
                return
            await self.station.show_result(str(session["calibration"]))

    async def on_data_table_row_selected(self) -> None:
        """Enter on a session: what it gave."""
        await self.action_result()

    def action_check(self) -> None:
        if (session := self._selected()) is not None:
            self.station.check(str(session["recording"]), str(session["folder"]))

    def action_drift(self) -> None:
        self.station.drift_check()

    def action_watch(self) -> None:
        if (session := self._selected()) is not None:
            self.station.watch_recording(str(session["folder"]))

    def action_recover(self) -> None:
        if (session := self._selected()) is not None:
            self.station.recover(str(session["folder"]))
