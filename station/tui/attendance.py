"""Is anybody there? An ssh that dies silently leaves this screen alive, and with it control of the arm."""

from __future__ import annotations

from textual import events

from station.protocol.states import RUNNING
from station.tui.commands import Commands

WHERE_IS_THE_CURSOR = "\x1b[6n"
"""ECMA-48's device status report: a terminal answers by itself, from where the person sits."""
ASK_S = 3.0
UNANSWERED = 5
GONE = "Nothing came back from your terminal for {:.0f} s: the arm was stopped, control was let go of."


class Attended(Commands):
    """Asks the terminal while this screen moves the arm. One that never answered is not waited for."""

    _unanswered: int | None = None
    """Questions since the last answer; None: there was none yet."""

    def on_mount(self) -> None:
        self._ask_terminal()
        self.set_interval(ASK_S, self._look_for_terminal)

    def on_cursor_position(self, event: events.CursorPosition) -> None:
        self._unanswered = 0

    def _ask_terminal(self) -> None:
        if self._driver is not None:
            self._driver.write(WHERE_IS_THE_CURSOR)

    async def _look_for_terminal(self) -> None:
        if self._unanswered is None:
            return
        if self.status is None or self.status.state not in RUNNING or not self.has_control():
            self._unanswered = 0
            return
        if self._unanswered >= UNANSWERED:
            await self.ask("lease", action="lost")
            self._unanswered = 0
            self.notify(GONE.format(ASK_S * UNANSWERED), severity="error", timeout=3600)
            return
        self._unanswered += 1
        self._ask_terminal()
