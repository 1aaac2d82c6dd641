"""Is anybody there: the daemon that is shown, and the person whom it is shown to.

An ssh that dies silently leaves this screen alive, and with it control of the arm.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from textual import events

from station.cell.errors import RefusedError
from station.protocol.states import RUNNING
from station.protocol.verbs import Lease, Watch
from station.tui.desk import Desk, Link

LISTEN_S = 0.5
SILENT_S = 2.0
"""A working daemon answers within milliseconds, on a busy computer within some hundred."""
_PATIENT_S = 7 * 86400.0
WHERE_IS_THE_CURSOR = "\x1b[6n"
"""ECMA-48's device status report: a terminal answers by itself, from where the person sits."""
ASK_S = 3.0
UNANSWERED = 5
TERMINAL_SILENT = "Terminal silent {:.0f} s. The arm was stopped, control released."


async def listen(link: Link, tell: Callable[[float | None], None]) -> None:
    """Ask something small again and again; ends with the link. A daemon that hangs keeps its socket open.

    `tell` hears for how many seconds it has not answered, and None when it did.
    """
    while True:
        asked_s = time.monotonic()
        answer = asyncio.ensure_future(link.call(Watch(), timeout_s=_PATIENT_S))
        try:
            while not (await asyncio.wait({answer}, timeout=LISTEN_S))[0]:
                if (waited_s := time.monotonic() - asked_s) >= SILENT_S:
                    tell(waited_s)
            problem = answer.exception()
        finally:
            answer.cancel()
        if problem is not None and not isinstance(problem, RefusedError):
            return
        tell(None)
        await asyncio.sleep(LISTEN_S)


class Attended(Desk):
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
            await self.ask(Lease("lost"))
            self._unanswered = 0
            self.notify(TERMINAL_SILENT.format(ASK_S * UNANSWERED), severity="error", timeout=3600)
            return
        self._unanswered += 1
        self._ask_terminal()
