"""Whether a person still sits at the terminal: an ssh that dies silently would keep control of the arm."""

from __future__ import annotations

from station.protocol.verbs import Release
from station.tui.desk import Desk

WHERE_IS_THE_CURSOR = "\x1b[6n"
"""ECMA-48's device status report: a terminal answers by itself, from where the person sits."""
ASK_S = 3.0
UNANSWERED = 5
TERMINAL_SILENT = "The terminal did not answer for {:.0f} s: the arm was stopped and control released."


class Attendance:
    """Asks the terminal while the arm works by this screen; without answers it releases control."""

    def __init__(self, desk: Desk) -> None:
        self._desk = desk
        self.unanswered: int | None = None
        """Questions since the last answer; None: there never was one, so this terminal cannot answer."""

    def begin(self) -> None:
        self.ask()
        self._desk.app.set_interval(ASK_S, self.look)

    def answered(self) -> None:
        self.unanswered = 0

    def ask(self) -> None:
        if (driver := self._desk.app._driver) is not None:
            driver.write(WHERE_IS_THE_CURSOR)

    async def look(self) -> None:
        if self.unanswered is None:
            return
        if not self._desk.known.works or not self._desk.has_control():
            self.unanswered = 0
        elif self.unanswered < UNANSWERED:
            self.unanswered += 1
            self.ask()
        else:
            await self._desk.ask(Release(silent=True))
            self.unanswered = 0
            said = TERMINAL_SILENT.format(ASK_S * UNANSWERED)
            self._desk.app.notify(said, severity="error", timeout=3600)
