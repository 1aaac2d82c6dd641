"""From the operator's keys to the daemon's verbs: what is asked first, what is said when it is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
from textual import work
from textual.app import App
from textual.reactive import reactive

from station.cell.errors import RefusedError, StationError
from station.cell.status import MotionPreview, SessionStatus, StationState, StationStatus
from station.protocol.states import RUNNING
from station.protocol.verbs import Finish
from station.tui.confirm import Confirm, ConfirmGo
from station.tui.link import Link
from station.tui.replay_screen import ReplayScreen

STOP_UNHEARD = "STOP was sent, but the station does not answer: use the EMERGENCY STOP on the pendant."


CLOSES = "The recording is closed; F9 then solves it."
WITHOUT = "It decelerates at once, and the session pauses."
STAYS = "The daemon and its session stay as they are; `station` opens this screen again."
PLAN_ANSWER_S = 200.0
"""Planning takes the daemon some seconds on a quick computer, and minutes on a busy one."""


class Commands(App[None]):
    """Every wish goes through `ask`; the daemon decides, nothing is decided here."""

    status: reactive[StationStatus | None] = reactive(None, repaint=False)
    known: StationStatus | None = None
    """The newest status; it outlives the daemon."""
    serves = True
    """A station stands behind this screen, not a recording alone."""
    link: Link | None = None
    """The connection while there is one."""
    stop_unconnected: Callable[[], bool] = staticmethod(lambda: False)
    """Sends STOP where there is no connection (`protocol.stop_client.send_stop`); False: nobody listens."""
    silent_s: float | None = None
    """For how long the daemon has not answered; None while it does."""
    trouble = ""
    """Why what is shown is not how it is: no daemon, or one that does not answer."""
    _own_id: int | None = None
    """How the daemon knows this connection, once it held the lease."""
    busy = ""
    """What the daemon is at work on for this screen; empty: nothing that takes long."""

    async def ask(self, verb: str, **args: Any) -> Any:
        """The daemon's answer, or None after a notice that says why not."""
        if verb != "stop" and any(isinstance(screen, ReplayScreen) for screen in self.screen_stack):
            self.notify("This is the PLAYBACK of a recording: Escape leaves it. F12 still stops the arm.")
            return None
        if self.link is None:
            if verb == "stop" and self.stop_unconnected():
                self.notify("STOP was sent without a connection: look at the arm.", severity="warning")
                return None
            self.notify("No connection to the daemon: nothing was sent.", severity="error")
            return None
        if self.silent_s is not None:
            if verb != "stop":
                self.notify("The station does not answer: nothing was sent.", severity="error")
                return None
            self.notify(STOP_UNHEARD, severity="error", timeout=10)
        try:
            return await self.link.request(verb, **args)
        except RefusedError as refused:
            self.notify(str(refused), severity="warning", timeout=10)
        except (OSError, StationError) as gone:
            self.notify(str(gone) or "The daemon is gone.", severity="error", timeout=10)
        return None

    @work(group="command", exit_on_error=False)
    async def send(self, verb: str, **args: Any) -> None:
        """A wish of one of the screens; control of the arm is taken with it."""
        await self.ask_with_control(verb, **args)

    async def ask_with_control(self, verb: str, **args: Any) -> Any:
        """As `ask`, for what only the holder of the lease may."""
        return await self.ask(verb, **args) if await self.take_control() else None

    async def take_control(self) -> bool:
        lease = await self.ask("lease", action="take")
        if lease is not None:
            self._own_id = lease.get("client_id")
        return lease is not None

    def has_control(self) -> bool:
        """This screen holds the lease, and no other."""
        holder = None if self.status is None else self.status.lease.client_id
        return holder is not None and holder == self._own_id

    async def ask_long(self, words: str, verb: str, **args: Any) -> Any:
        """As `ask_with_control`, for what takes seconds or, on a busy computer, minutes.

        `words` stand on every screen for as long as it does.
        """
        if self.busy:
            self.notify(f"One after the other: {self.busy}")
            return None
        self.tell_busy(words)
        try:
            return await self.ask_with_control(verb, timeout_s=PLAN_ANSWER_S, **args)
        finally:
            self.tell_busy("")

    def tell_busy(self, words: str) -> None:
        self.busy = words

    @work(group="stop", exit_on_error=False)
    async def action_stop(self) -> None:
        await self.ask("stop")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_run(self) -> None:
        resuming = self.status is not None and self.status.state is StationState.PAUSED
        await self.go_for("resume" if resuming else "run")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_improve(self) -> None:
        """The poses that are left, planned anew from the pictures so far; taken up by its go alone."""
        await self.go_for("improve", "Planning the poses that are left anew … Nothing moves.")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_best(self) -> None:
        """One pose more, the one that would help most; taken up by its go alone."""
        await self.go_for("best", "Looking for the pose that would help most … Nothing moves.")

    async def go_for(
        self, purpose: str, words: str = "Checking the way … Nothing moves.", changes: tuple[str, ...] = ()
    ) -> bool:
        """Prepare, ask the person, go: how the keys of a session move the arm. True: it was told to go.

        `changes`: what else a yes changes.
        """
        answer = await self.ask_long(words, "prepare", purpose=purpose)
        if answer is None:
            return False
        go = msgspec.convert(answer, MotionPreview)
        go = msgspec.structs.replace(go, changes=(*changes, *go.changes))
        if not await self.push_screen_wait(ConfirmGo(go)):
            return False
        went = await self.ask("go", token=go.token) is not None
        if went:
            self.clear_notifications()  # they were of the time before
        return went

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_pause(self) -> None:
        await self.ask("pause")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_finish(self) -> None:
        if self.status is not None and (refusal := Finish.refusal(self.status.state)) is not None:
            self.notify(str(refusal), severity="warning")
            return
        session = SessionStatus() if self.status is None else self.status.session
        question = f"{session.captured} of {len(session.poses)} poses are captured. {CLOSES}"
        if await self.push_screen_wait(Confirm("Finish this session?", question, yes="Finish")):
            await self.ask_with_control("finish")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_free_drive(self) -> None:
        """The operator moves the arm with the pendant's free-drive button; the station only looks."""
        if self.status is None:
            return
        on = self.status.state is not StationState.FREE_DRIVE
        await self.ask_with_control("free_drive", on=on)

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_record(self) -> None:
        await self.ask_with_control("record")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_acknowledge(self) -> None:
        if await self.ask("acknowledge") is not None:
            self.clear_notifications()  # what they said of the stop is over

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_let_go(self) -> None:
        """Another screen or a command may take control then."""
        if self.status is None or not self.has_control():
            holder = "" if self.status is None else self.status.lease.holder
            self.notify(f"This screen does not hold control: {holder or 'nobody'} does.")
            return
        if self.status.state in RUNNING and not await self.push_screen_wait(
            Confirm("Let go of control?", f"The arm works. {WITHOUT}", yes="Let go")
        ):
            return
        await self.ask("lease", action="release")
        self.notify("Control was let go of: another screen or command may take it.")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_leave(self) -> None:
        state = None if self.status is None else self.status.state
        if self.serves and state not in (None, StationState.IDLE, StationState.DISCONNECTED):
            held = state in RUNNING and self.has_control()
            text = f"The arm works, commanded from here. {WITHOUT}" if held else STAYS
            if not await self.push_screen_wait(Confirm("Close the screen?", text, yes="Close")):
                return
        self.exit()
