"""The daemon as the screens ask it: connection, silence, and what is said when it refuses."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any, TypeVar

import msgspec
from textual.reactive import reactive
from textual.screen import Screen

from recordings.errors import CodedError
from station.cell.errors import RefusedError, StationError
from station.cell.status import StationStatus
from station.protocol import verbs
from station.protocol.client import ANSWER_S, Client
from station.protocol.results import Kept, Result
from station.protocol.verbs import Release, Verb
from station.tui.task import Known
from station.tui.themes import ThemedApp
from station.tui.words import duration

R = TypeVar("R")
LISTEN_S = 0.5
SILENT_S = 2.0
"""A working daemon answers within milliseconds, on a busy computer within some hundred."""
_PATIENT_S = 7 * 86400.0
STATUS_PERIOD_S = 0.25
"""Laying out what flickers is most of what this screen costs: four times a second are enough for eyes."""
RECONNECT_S = 1.0
READ_S = 60.0
LIST_S = 180.0
"""Longest waits for a result and for the list of sessions: on a busy computer reading takes its time."""
CHANGE_S = 120.0
"""Longest wait for an installation, which may wait for a list that is being read."""
GONE = "The daemon ended: the controller stops the arm. This screen goes on when a daemon serves again."
STOP_UNHEARD = "STOP was sent, but the station does not answer: press the EMERGENCY STOP on the pendant."
BUSY: dict[type[Verb[Any]], str] = {
    verbs.MakePlan: "Planning …",
    verbs.Prepare: "Checking the path …",
    verbs.Observe: "Looking for the board …",
    verbs.Install: "Installing …",
    verbs.Rollback: "Going back …",
    verbs.Withdraw: "Taking it out of use …",
}
"""Words for a verb that takes seconds, or minutes on a busy computer. Others are answered at once."""


class DaemonApp(ThemedApp[None]):
    """An app whose screens are drawn from `known` and ask the daemon by one `link`."""

    known: reactive[Known] = reactive(Known(), repaint=False)
    result_session: reactive[str] = reactive("", repaint=False, always_update=True)
    """Session of the calibration that the result screen shows; empty: the one just captured."""
    link: DaemonLink

    def hear(self, status: StationStatus | None, why: str = "") -> None:
        """Take the newest status; None: there is no daemon, and `why`."""

    async def show_result(self, session: str) -> None:
        """Show the calibration made from a session."""
        self.result_session = session
        await self.switch_mode("result")


class DaemonLink:
    """The screen's way to the daemon: kept open, listened to for silence, and every refusal a notice.

    The daemon decides, nothing is decided here.
    """

    def __init__(self, app: DaemonApp, client: Client) -> None:
        self.app, self.client = app, client
        client.guard = self._guard

    @property
    def known(self) -> Known:
        return self.app.known

    # --- the daemon → the screen ---

    async def follow(self) -> None:
        """Stay connected for as long as the screen lives."""
        while True:
            why = GONE
            try:
                await self.client.open()
                self.app.run_worker(self._listen(), group="listen", exclusive=True)
                async for status in self.client.statuses():
                    await self._pace(status)
                    self.app.hear(status)
            except (OSError, StationError) as problem:
                why = str(problem)
            except msgspec.ValidationError as problem:
                why = f"The daemon is of another version than this screen ({problem}): restart the older one."
            await self.client.close()
            self.app.hear(None, why)
            await asyncio.sleep(RECONNECT_S)

    async def _pace(self, status: StationStatus) -> None:
        """A new state or reason is shown at once; numbers that only flicker, a few times a second."""
        shown = self.known.live
        if shown is not None and (shown.state, shown.reason) == (status.state, status.reason):
            await asyncio.sleep(STATUS_PERIOD_S)

    async def _listen(self) -> None:
        """Ask something small until the link ends: a daemon that hangs keeps its socket open."""
        while True:
            asked_s = time.monotonic()
            answer = asyncio.ensure_future(self.client.call(verbs.Watch(), timeout_s=_PATIENT_S))
            try:
                while not (await asyncio.wait({answer}, timeout=LISTEN_S))[0]:
                    if (waited_s := time.monotonic() - asked_s) >= SILENT_S:
                        self.app.known = replace(self.known, silent_s=waited_s)
                problem = answer.exception()
            finally:
                answer.cancel()
            if problem is not None and not isinstance(problem, RefusedError):
                return
            self.app.known = replace(self.known, silent_s=None)
            await asyncio.sleep(LISTEN_S)

    # --- the screen → the daemon ---

    @contextmanager
    def _guard(self, verb: Verb[object]) -> Iterator[None]:
        """Show what takes long on every screen; to a daemon that is silent send nothing but STOP."""
        if self.known.silent_s is not None and not isinstance(verb, verbs.Stop | verbs.Watch):
            raise StationError("daemon-silent")
        words = BUSY.get(type(verb))
        if words and self.known.busy:
            raise RefusedError("screen-busy", work=self.known.busy)
        with self.busy(f"{words} Nothing moves.") if words else nullcontext():
            yield

    @contextmanager
    def busy(self, words: str) -> Iterator[None]:
        """Say on every screen what is waited for, and for how long already."""
        begun_s = time.monotonic()

        def tell() -> None:
            self.app.known = replace(self.known, busy=f"{words} {duration(time.monotonic() - begun_s)}")

        tell()
        timer = self.app.set_interval(1.0, tell)
        try:
            yield
        finally:
            timer.stop()
            self.app.known = replace(self.known, busy="")

    async def attempt(self, work: Awaitable[R]) -> R | None:
        """Its result, or None after a notice that says why not."""
        try:
            return await work
        except (CodedError, OSError) as problem:
            self.tell(problem)
        return None

    def tell(self, problem: Exception) -> None:
        """Show a notice of what was refused, or failed."""
        refused = isinstance(problem, RefusedError)
        self.app.notify(str(problem), severity="warning" if refused else "error", timeout=10, markup=False)

    async def ask(self, verb: Verb[R], *, timeout_s: float = ANSWER_S) -> R | None:
        """Call a verb; a notice takes the place of an error."""
        return await self.attempt(self.client.call(verb, timeout_s=timeout_s))

    async def result(self, session: str) -> Result | None:
        """Ask for the calibration of a session; empty: see `GetResult`. None: there is none yet."""
        answer = await self.client.call(verbs.GetResult(session), timeout_s=READ_S)
        return None if answer.result is None else msgspec.convert(answer.result, Result)

    async def sessions(self) -> tuple[Kept, ...]:
        """Ask for the recorded sessions, newest first."""
        answer = await self.client.call(verbs.GetSessions(), timeout_s=LIST_S)
        return msgspec.convert(answer.sessions, tuple[Kept, ...])

    async def ask_person(self, screen: Screen[R]) -> R:
        """Ask by a window; only in a worker."""
        return await self.app.push_screen_wait(screen)

    async def start(self, begun: Awaitable[R]) -> R | None:
        """A flow that begins with a motion; None when it did not come to that."""
        if started := await self.attempt(begun):
            self.app.clear_notifications()  # they were of the time before
        return started

    def has_control(self) -> bool:
        """Tell whether this screen has control."""
        return self.known.has_control

    async def stop(self) -> None:
        """STOP, whatever is shown, and also where nobody answers or no connection is left."""
        if not self.client.connected:
            if unsent := self.client.send_stop():
                self.app.notify(unsent, severity="error", timeout=10, markup=False)
            else:
                self.app.notify("STOP was sent without a connection: look at the arm.", severity="warning")
            return
        if self.known.silent_s is not None:
            self.app.notify(STOP_UNHEARD, severity="error", timeout=10)
        await self.attempt(self.client.call(verbs.Stop()))


WHERE_IS_THE_CURSOR = "\x1b[6n"
"""ECMA-48's device status report: a terminal answers by itself, from where the person sits."""
ASK_S = 3.0
UNANSWERED = 5
TERMINAL_SILENT = "The terminal did not answer for {:.0f} s: the arm was stopped and control released."


class TerminalWatch:
    """Asks the terminal while the arm works by this screen; without answers it releases control."""

    def __init__(self, link: DaemonLink) -> None:
        self._link = link
        self.unanswered: int | None = None
        """Questions since the last answer; None: there never was one, so this terminal cannot answer."""

    def begin(self) -> None:
        self.ask()
        self._link.app.set_interval(ASK_S, self.look)

    def answered(self) -> None:
        self.unanswered = 0

    def ask(self) -> None:
        if (driver := self._link.app._driver) is not None:
            driver.write(WHERE_IS_THE_CURSOR)

    async def look(self) -> None:
        if self.unanswered is None:
            return
        if not self._link.known.works or not self._link.has_control():
            self.unanswered = 0
        elif self.unanswered < UNANSWERED:
            self.unanswered += 1
            self.ask()
        else:
            await self._link.ask(Release(silent=True))
            self.unanswered = 0
            said = TERMINAL_SILENT.format(ASK_S * UNANSWERED)
            self._link.app.notify(said, severity="error", timeout=3600)
