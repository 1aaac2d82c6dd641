"""The operator's screen: a client that shows the daemon's status and sends the operator's wishes.

It holds no truth: closing it, killing it or losing ssh loses nothing but control, and the daemon then
decelerates the arm and pauses.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterable
from functools import partial
from pathlib import Path
from typing import ClassVar

import msgspec
from textual import events, work
from textual.app import SystemCommand
from textual.binding import Binding, BindingType
from textual.message import Message
from textual.screen import Screen

from station.cell.errors import RefusedError, StationError
from station.cell.status import StationState, StationStatus
from station.protocol.client import Client
from station.protocol.states import RUNNING
from station.protocol.stop_client import send_stop
from station.protocol.verbs import Configuration, Lease, Sessions, Watch
from station.tui.connect import ConnectScreen
from station.tui.desk import ScreenLink
from station.tui.dialogs import Help
from station.tui.frame import Framed
from station.tui.installed import LOOK_S
from station.tui.live import LiveScreen, LogScreen
from station.tui.plan import PlanScreen
from station.tui.replay import ReplayLink
from station.tui.replay_screen import Player, ReplayScreen
from station.tui.result import InstallScreen, SolveScreen, VerifyScreen
from station.tui.results import ResultsDesk
from station.tui.screen import StationScreen
from station.tui.sessions import SessionsScreen
from station.tui.task import DIGITS
from station.tui.widgets.graphics import detect
from station.tui.widgets.preview import PreviewPane

Connect = Callable[[], Awaitable[ScreenLink]]
LISTEN_S = 0.5
SILENT_S = 2.0
"""A working daemon answers within milliseconds, on a busy computer within some hundred."""
_PATIENT_S = 7 * 86400.0
WHERE_IS_THE_CURSOR = "\x1b[6n"
"""ECMA-48's device status report: a terminal answers by itself, from where the person sits."""
ASK_S = 3.0
UNANSWERED = 5
TERMINAL_SILENT = "Terminal silent {:.0f} s. The arm was stopped, control released."
PREVIEW_PERIOD_S = 0.25
STATUS_PERIOD_S = 0.25
"""Laying out what flickers is most of what this screen costs: four times a second are enough for eyes."""
SETTLED_S = 2.0
RECONNECT_S = 1.0
GONE = "The daemon ended: the controller stops the arm. This screen goes on when a daemon serves again."
SILENT = (
    "Daemon not responding: the data below are old. The arm's watchdog stops it; if it moves, press the "
    "emergency stop."
)


def freeze_startup() -> None:
    """Keep what was loaded out of garbage collection, which would make STOP wait (~100 ms)."""
    gc.collect()
    gc.freeze()


SCREENS: tuple[type[StationScreen], ...] = (
    ConnectScreen,
    PlanScreen,
    LiveScreen,
    SolveScreen,
    VerifyScreen,
    InstallScreen,
    SessionsScreen,
    LogScreen,
)


async def listen(link: ScreenLink, tell: Callable[[float | None], None]) -> None:
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


class StatusChanged(Message):
    """None: there is no daemon, and `why`."""

    def __init__(self, status: StationStatus | None, why: str = "") -> None:
        super().__init__()
        self.status, self.why = status, why


class StationApp(ResultsDesk):
    """One app, several screens; the same keys everywhere."""

    TITLE = "Calibration station"
    CSS_PATH = "station.tcss"
    MODES: ClassVar[dict[str, type[StationScreen]]] = {screen.MODE: screen for screen in SCREENS}  # type: ignore[assignment]
    DEFAULT_MODE = "capture"
    _unanswered: int | None = None
    """Questions since the last answer; None: there was none yet."""
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f12", "stop", "STOP", show=False, priority=True, id="stop", tooltip="Stop the arm now"),
        Binding(
            "f1", "help", "Help", show=False, id="help", tooltip="What this screen is for, and all its keys"
        ),
        Binding("f5", "start('run')", "Run", id="run", tooltip="Check the path, show the motion, and ask"),
        Binding("f6", "ask('pause')", "Pause", id="pause", tooltip="Stop after this pose; nothing is lost"),
        Binding("f7", "finish", "Finish", id="finish", tooltip="Finish the recording with the poses so far"),
        Binding(
            "f8",
            "acknowledge",
            "Acknowledge",
            show=False,
            priority=True,
            id="acknowledge",
            tooltip="Leave STOPPED or FAULT after looking",
        ),
        Binding("f9", "solve_newest", "Solve", id="solve", tooltip="Solve the session just recorded"),
        Binding("f3", "freedrive", "Freedrive", id="freedrive", tooltip="Freedrive: move the arm by hand"),
        Binding("f2", "ask('record')", "Image", id="record", tooltip="Capture an image here (freedrive)"),
        Binding("f4", "release", "Release", show=False, id="release", tooltip="Release control of the arm"),
        *(
            Binding(DIGITS[s.MODE], f"open('{s.MODE}')", s.MODE.title(), show=False, id=s.MODE, tooltip=s.TIP)
            for s in SCREENS
        ),
        Binding(
            "ctrl+q", "leave", "Quit", show=False, id="quit", tooltip="Close this screen; the daemon goes on"
        ),
    ]

    def __init__(self, connect: Connect) -> None:
        super().__init__()
        self._connect = connect
        self._greeted = False

    def on_mount(self) -> None:
        self.follow()
        self.fetch_previews()
        self.set_timer(SETTLED_S, freeze_startup)
        self._ask_terminal()
        self.set_interval(ASK_S, self._look_for_terminal)
        self.set_interval(LOOK_S, self._look)

    def _look(self) -> None:
        """A daemon at work is left in peace."""
        if self.status is None or self.status.state not in RUNNING:
            self.look_at_results()

    async def action_open(self, mode: str) -> None:
        await self.switch_mode(mode)

    # --- the person: an ssh that dies silently leaves this screen alive, and with it control of the arm ---

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

    # --- the daemon → the screen ---

    @work(exclusive=True, group="follow", exit_on_error=False)
    async def follow(self) -> None:
        """Stays connected for as long as the screen lives."""
        while True:
            why = GONE
            try:
                self.link = await self._connect()
                self.run_worker(listen(self.link, self.hear), group="listen", exclusive=True)
                async for status in self.link.statuses():
                    self.tell_newest(status)
                    await self._pace(status)
                    self.post_message(StatusChanged(status))
            except (OSError, StationError) as problem:
                why = str(problem)
            except msgspec.ValidationError as problem:
                why = f"The daemon is of another version than this screen ({problem}): restart the older one."
            gone, self.link = self.link, None
            if gone is not None:
                await gone.close()
            self.post_message(StatusChanged(None, why))
            await asyncio.sleep(RECONNECT_S)

    def hear(self, silent_s: float | None) -> None:
        """Hear for how long the daemon has not answered; None: it does."""
        if silent_s is None and self.silent_s is None:
            return
        self.silent_s = silent_s
        self._tell_trouble("" if silent_s is None else SILENT)

    def _tell_trouble(self, trouble: str) -> None:
        self.trouble = trouble
        self._show()

    def _show(self) -> None:
        """Show the status on every screen and question that stands over another."""
        known = self.known()
        for screen in self.screen_stack:
            # Closing, the app takes the screens' parts away before its workers end.
            if isinstance(screen, Framed) and screen.is_mounted and self.is_running:
                screen.show(known)

    def playing(self) -> bool:
        return any(isinstance(screen, ReplayScreen) for screen in self.screen_stack)

    def tell_busy(self, words: str) -> None:
        super().tell_busy(words)
        self._show()

    async def _pace(self, status: StationStatus) -> None:
        """A new state or reason is shown at once; numbers that only flicker, a few times a second."""
        known = self.status
        if known is not None and (known.state, known.reason) == (status.state, status.reason):
            await asyncio.sleep(STATUS_PERIOD_S)

    @work(exclusive=True, group="preview", exit_on_error=False)
    async def fetch_previews(self) -> None:
        """Only for a screen that shows them, and only as large as it can show."""
        while True:
            await asyncio.sleep(PREVIEW_PERIOD_S)
            screen = self.screen
            link = screen.link if isinstance(screen, ReplayScreen) else self.link
            if link is None:
                continue
            for preview in screen.query(PreviewPane):
                with contextlib.suppress(OSError, StationError):
                    await preview.fetch(link)

    def on_status_changed(self, message: StatusChanged) -> None:
        before, self.status = self.status, message.status
        if message.status is None:
            self.silent_s = None
        elif before is None or before.session.calibration != message.status.session.calibration:
            self.look_at_results()
        elif before.session.name and not message.status.session.name:
            self.result_path = ""  # another session begins: what was looked at is no part of it
        if message.status is not None and not self._greeted:
            self._greeted = True
            self.greet(message.status)
            self.learn_cell()
        self._show()
        if self.silent_s is None and self.trouble != message.why:
            self._tell_trouble(message.why)

    @work(exit_on_error=False)
    async def learn_cell(self) -> None:
        """Learn the cell that the scenes are drawn from; an older daemon does not tell."""
        if self.link is not None:
            with contextlib.suppress(OSError, StationError):
                self.configuration = await self.link.call(Configuration())

    @work(exit_on_error=False)
    async def greet(self, status: StationStatus) -> None:
        """Show what is missing to a person who starts for the first time, or without a robot."""
        if status.playback:
            return
        missing = status.state is StationState.DISCONNECTED
        unused = not status.session.poses and await self.ask(Sessions()) == []
        if (missing or unused) and self.current_mode == self.DEFAULT_MODE:
            await self.switch_mode("connect")

    def common_actions(self) -> list[str]:
        """Actions that have a key on every screen; a playback adds its own."""
        return [binding.action for binding in StationApp.BINDINGS if isinstance(binding, Binding)]

    def get_key_display(self, binding: Binding) -> str:
        """F5 as it is printed on the key, and as every text here calls it."""
        shown = super().get_key_display(binding)
        return shown.upper() if shown[0] == "f" and shown[1:].isdigit() else shown

    def action_help(self) -> None:
        """Own bindings in a window that fits a console; Textual's panel halves the screen."""
        screen = self.screen
        if isinstance(screen, StationScreen):
            own = screen.BINDINGS
            ours = [kind for kind in type(self).__mro__ if kind.__module__.startswith("station.")]
            common = [binding for kind in ours for binding in vars(kind).get("BINDINGS", [])]
            self.push_screen(Help(screen.heading, screen.HELP or "", [*own, *common]))

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_new_cell(self) -> None:
        """The wizard in this terminal's place; this screen comes back when it is left."""
        with self.suspend():
            await asyncio.to_thread(subprocess.run, [sys.executable, "-m", "station.cli", "new"], check=False)

    def get_system_commands(self, screen: Screen[object]) -> Iterable[SystemCommand]:
        """Every key's action by name too; what moves the arm asks the same question from here."""
        yield from super().get_system_commands(screen)
        yield SystemCommand("New cell", "Set up a robot, a camera and a board", self.action_new_cell)
        own = screen.BINDINGS if isinstance(screen, StationScreen) else []
        for place, bindings in ((screen, own), (self, self.BINDINGS)):
            for binding in (b for b in bindings if isinstance(b, Binding) and b.tooltip):
                yield SystemCommand(
                    f"{binding.description} ({binding.key})",
                    binding.tooltip,
                    partial(self.call_later, self.run_action, binding.action, place),
                )


class ReplayApp(Player, StationApp):
    """The same screens over a recording alone."""

    serves = False
    BINDINGS: ClassVar[list[BindingType]] = [*Player.BINDINGS]

    def __init__(self, link: ReplayLink) -> None:
        async def connect() -> ScreenLink:
            return link

        super().__init__(connect)
        self.player = link


def run(socket: Path, who: str = "") -> None:
    """Opens the screen on the daemon that serves `socket` and returns when it is closed."""

    async def connect() -> ScreenLink:
        return await Client.connect(socket, who)

    app = StationApp(connect)
    app.graphics = detect()
    app.stop_unconnected = partial(send_stop, socket)
    app.run()


def run_replay(recording: Path) -> None:
    """The live screen over a recording; no daemon is asked. StationError when it cannot be read."""
    app = ReplayApp(ReplayLink(recording))
    app.graphics = detect()
    app.run()
