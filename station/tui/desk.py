"""The screen's desk: what is asked of the daemon, what a person is asked first, what is said when refused."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar

from textual import work
from textual.content import Content
from textual.reactive import reactive

from recordings.errors import CodedError
from recordings.files import MAIN_CAMERA
from station.cell.config import StationConfig
from station.cell.errors import RefusedError, StationError
from station.cell.status import MotionPreview, SessionStatus, StationState, StationStatus
from station.operate import motion
from station.operate.motion import prepared_motion
from station.protocol import verbs
from station.protocol.client import ANSWER_S
from station.protocol.states import RUNNING
from station.protocol.verbs import Purpose, Verb
from station.tui.dialogs import Confirm, ConfirmMotion
from station.tui.task import Known
from station.tui.themes import ThemedApp
from station.tui.widgets.graphics import Graphics
from station.tui.widgets.scene import cell_scene, draw

R = TypeVar("R")
STOP_UNHEARD = "STOP was sent, but the station does not answer: press the EMERGENCY STOP on the pendant."
DECELERATES = "It decelerates at once, and the session pauses."
REMEDIES = {
    "nothing-installed": "4 shows the newest result, i installs it.",
    "no-pointer": "Give its length (Tab in the list of corners), or set the tool on the pendant.",
    "unfinished-recording": "c on 7 recovers it.",
}
"""By an error's code, where the way out on a screen is another than in a shell."""
BUSY: dict[Purpose, str] = {
    Purpose.REPLAN: "Planning the remaining poses again … Nothing moves.",
    Purpose.NEXT_POSE: "Looking for the most useful pose … Nothing moves.",
}


class ScreenLink(motion.Link, Protocol):
    """A connection: `station.protocol.client.Client`, a recording, or a test's own."""

    max_age_days: float | None
    """Oldest proof of a calibration by the cell's rule; None: none."""

    async def close(self) -> None: ...


class Desk(ThemedApp[None]):
    """Every wish goes through `call`; the daemon decides, nothing is decided here.

    For the flows of `station.operate` it is a link: it takes control where a verb needs it, and says on every
    screen what the daemon is at work on.
    """

    status: reactive[StationStatus | None] = reactive(None, repaint=False)
    serves = True
    """A station stands behind this screen, not a recording alone."""
    link: ScreenLink | None = None
    """The connection while there is one."""
    stop_unconnected: Callable[[], bool] = staticmethod(lambda: False)
    """Sends STOP where there is no connection (`protocol.stop_client.send_stop`); False: nobody listens."""
    silent_s: float | None = None
    """Seconds without an answer from the daemon; None while it answers."""
    trouble = ""
    """Reason why the screen is old: no daemon, or one that does not answer."""
    busy = ""
    """Long work of the daemon for this screen, in words; empty: none."""
    graphics: Graphics | None = None
    """The terminal's own graphics; None: half blocks only."""
    configuration: StationConfig | None = None
    """Facts of the cell; None until the daemon told them."""
    _own_id: int | None = None
    """The daemon's number of this connection, once it had control."""
    _newest: StationStatus | None = None

    def __init__(self) -> None:
        super().__init__()
        self._news = asyncio.Event()
        """Set, and replaced, with every new status."""

    @property
    def root(self) -> Path | None:
        """Below which the daemon keeps sessions and what is installed."""
        return None if self.link is None else self.link.root

    @property
    def camera(self) -> str:
        """Name of the daemon's camera."""
        return MAIN_CAMERA if self.link is None else self.link.camera

    @property
    def max_age_days(self) -> float | None:
        """Oldest proof of a calibration by the cell's rule."""
        return None if self.link is None else self.link.max_age_days

    def known(self) -> Known:
        """All that rail and next action are made of."""
        return Known(self.status, silent_s=self.silent_s, busy=self.busy, trouble=self.trouble)

    def newest(self) -> Known:
        """Return what is known, with the newest status there ever was; it outlives the daemon."""
        return replace(self.known(), status=self._newest)

    def common_actions(self) -> list[str]:
        """Actions that have a key on every screen."""
        return []

    def playing(self) -> bool:
        """A recording is shown in place of the cell."""
        return False

    async def call(self, verb: Verb[R], *, timeout_s: float = ANSWER_S) -> R:
        """The verb's result. Raises StationError, also where nothing is sent: in a playback, while silent."""
        if self.playing():
            raise RefusedError(
                "This is the PLAYBACK of a recording.",
                code="playback",
                remedy="Escape leaves it; F12 still stops the arm.",
            )
        if self.link is None:
            raise StationError("No connection to the daemon: nothing was sent.", code="no-daemon")
        if self.silent_s is not None:
            raise StationError("The station does not answer: nothing was sent.", code="no-answer")
        words = busy_words(verb)
        if words and self.busy:
            raise RefusedError(f"Busy: {self.busy}", code="busy", remedy="Wait until it is done.")
        if words:
            self.tell_busy(words)
        try:
            if verb.control and not isinstance(verb, verbs.Go):  # who approves had it before
                await self._take_control(self.link)
            return await self.link.call(verb, timeout_s=timeout_s)
        finally:
            if words:
                self.tell_busy("")

    async def _take_control(self, link: ScreenLink) -> None:
        self._own_id = (await link.call(verbs.Lease("take"))).client_id

    async def statuses(self) -> AsyncIterator[StationStatus]:
        """Every new status from now on, slow readers the newest only."""
        seen = self._newest
        while True:
            while self._newest is None or self._newest is seen:
                await self._news.wait()
            seen = self._newest
            yield seen

    def tell_newest(self, status: StationStatus) -> None:
        """Hand a status to `statuses`, before the screens' own slower pace."""
        self._newest = status
        self._news.set()
        self._news = asyncio.Event()

    def outdate(self) -> None:
        if self.link is not None:
            self.link.outdate()

    async def attempt(self, work: Awaitable[R]) -> R | None:
        """Its result, or None after a notice that says why not."""
        try:
            return await work
        except (CodedError, OSError) as problem:
            refused = isinstance(problem, RefusedError)
            self.notify(told(problem), severity="warning" if refused else "error", timeout=10, markup=False)
        return None

    async def ask(self, verb: Verb[R], *, timeout_s: float = ANSWER_S) -> R | None:
        """Call a verb; a notice takes the place of an error."""
        return await self.attempt(self.call(verb, timeout_s=timeout_s))

    @work(group="command", exit_on_error=False)
    async def send(self, verb: Verb[object]) -> None:
        """A wish of one of the screens."""
        await self.ask(verb)

    def has_control(self) -> bool:
        """Tell whether this screen has control."""
        holder = None if self.status is None else self.status.lease.client_id
        return holder is not None and holder == self._own_id

    def tell_busy(self, words: str) -> None:
        self.busy = words

    async def approves(self, preview: MotionPreview) -> bool:
        """The one question before anything moves."""

        def drawn(width: int, height: int) -> Content:
            status = self.status or StationStatus()
            scene = cell_scene(self.configuration, status)
            return Content() if scene is None else draw(scene, status, self._first(), width, height)

        question: Confirm = ConfirmMotion(preview, drawn)
        return await self.push_screen_wait(question)

    async def plans_here(self, refusal: StationError) -> bool:
        """Offer to plan again from where the arm stands."""
        return await self.push_screen_wait(Confirm("Plan again from here?", refusal.text, yes="Plan"))

    def _first(self) -> int | None:
        """Place of the pose that comes next."""
        poses = () if self.status is None else self.status.session.poses
        return next((place for place, pose in enumerate(poses) if pose.state == "planned"), None)

    async def start(self, begun: Awaitable[R]) -> R | None:
        """A flow that begins with a motion; None when it did not come to that."""
        if started := await self.attempt(begun):
            self.clear_notifications()  # they were of the time before
        return started

    # --- keys ---

    @work(group="stop", exit_on_error=False)
    async def action_stop(self) -> None:
        await self.stop()

    async def stop(self) -> None:
        """STOP, whatever is shown, and also where nobody answers or no connection is left."""
        if self.link is None:
            if self.stop_unconnected():
                self.notify("STOP was sent without a connection: look at the arm.", severity="warning")
            else:
                self.notify("No connection to the daemon: nothing was sent.", severity="error")
            return
        if self.silent_s is not None:
            self.notify(STOP_UNHEARD, severity="error", timeout=10)
        await self.attempt(self.link.call(verbs.Stop()))

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_start(self, purpose: str) -> None:
        """`run` goes on with a session that is paused."""
        paused = self.status is not None and self.status.state is StationState.PAUSED
        wanted = Purpose.RESUME if purpose == Purpose.RUN and paused else Purpose(purpose)
        await self.start(prepared_motion(self, wanted, self.approves, plans_here=self.plans_here))

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_ask(self, verb: str) -> None:
        """A verb without arguments."""
        await self.ask(verbs.VERBS[verb]())

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_finish(self) -> None:
        if self.status is not None and (refusal := verbs.Finish.refusal(self.status.state)) is not None:
            self.notify(str(refusal), severity="warning")
            return
        session = SessionStatus() if self.status is None else self.status.session
        captured = f"{session.captured} of {len(session.poses)} poses are captured."
        body = f"{captured} The recording is closed; F9 then solves it."
        if await self.push_screen_wait(Confirm("Finish this session?", body, yes="Finish")):
            await self.ask(verbs.Finish())

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_freedrive(self) -> None:
        """Capture by hand: the operator holds the pendant's freedrive button, the station only looks."""
        if self.status is not None:
            await self.ask(verbs.Freedrive(self.status.state is not StationState.FREE_DRIVE))

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_acknowledge(self) -> None:
        if await self.ask(verbs.Acknowledge()) is not None:
            self.clear_notifications()  # what they said of the stop is over

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_release(self) -> None:
        """Another screen or a command may take control then."""
        if self.status is None or not self.has_control():
            holder = "" if self.status is None else self.status.lease.holder
            self.notify(f"This screen does not have control: {holder or 'nobody'} does.", markup=False)
            return
        body = f"The arm works. {DECELERATES}"
        if self.status.state not in RUNNING or await self.push_screen_wait(
            Confirm("Release control?", body, yes="Release")
        ):
            await self.ask(verbs.Lease("release"))
            self.notify("Control released: another screen or command may take it.")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_leave(self) -> None:
        state = None if self.status is None else self.status.state
        if self.serves and state not in (None, StationState.IDLE, StationState.DISCONNECTED):
            held = state in RUNNING and self.has_control()
            text = (
                f"The arm works, commanded from here. {DECELERATES}"
                if held
                else "The daemon and its session stay as they are; `station` opens this screen again."
            )
            if not await self.push_screen_wait(Confirm("Close the screen?", text, yes="Close")):
                return
        self.exit()


def told(problem: CodedError | OSError) -> str:
    """The text of an error with the remedy that a screen offers."""
    if isinstance(problem, OSError) or problem.code not in REMEDIES:
        return str(problem)
    return f"{problem.text.rstrip('.')}. {REMEDIES[problem.code]}"


def busy_words(verb: Verb[object]) -> str:
    """Words for a verb that takes seconds, or minutes on a busy computer; empty: it is answered at once."""
    match verb:
        case verbs.MakePlan():
            return f"Planning {verb.poses} poses … Nothing moves."
        case verbs.Prepare():
            return BUSY.get(verb.purpose, "Checking the path … Nothing moves.")
        case verbs.Hover():
            return f"Looking for a path over corner {verb.corner} … Nothing moves."
    return ""
