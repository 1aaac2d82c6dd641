"""The operator's screen: a client that shows the daemon's status and sends the operator's wishes.

It holds no truth: closing it, killing it or losing ssh changes nothing but the lease, whose loss
makes the daemon decelerate the arm and pause.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import msgspec
from textual import work
from textual.app import App, SystemCommand
from textual.binding import Binding, BindingType
from textual.message import Message
from textual.reactive import reactive
from textual.screen import Screen

from station.client import Client
from station.errors import RefusedError, StationError
from station.protocol import Verb
from station.status import GoSummary, StationState, StationStatus
from station.tui import offline
from station.tui.checklist import ChecklistScreen
from station.tui.confirm import Confirm, ConfirmGo
from station.tui.link import Connect, Link
from station.tui.live import LiveScreen
from station.tui.log import LogScreen
from station.tui.plan import PlanScreen
from station.tui.result import ResultScreen
from station.tui.screen import StationScreen
from station.tui.sessions import SessionsScreen
from station.tui.widgets.preview import Preview

PREVIEW_PERIOD_S = 0.25
RECONNECT_S = 1.0


class StatusChanged(Message):
    def __init__(self, status: StationStatus | None) -> None:
        super().__init__()
        self.status = status


class StationApp(App[None]):
    """One app, several screens; the same keys everywhere."""

    TITLE = "Calibration station"
    CSS_PATH = "station.tcss"
    MODES: ClassVar[dict[str, Any]] = {
        "live": LiveScreen,
        "plan": PlanScreen,
        "result": ResultScreen,
        "sessions": SessionsScreen,
        "log": LogScreen,
        "checklist": ChecklistScreen,
    }
    DEFAULT_MODE = "live"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f12", "stop", "STOP", priority=True, id="stop", tooltip="Stop the arm now; from any screen"),
        Binding("f5", "run", "Run", id="run", tooltip="Check the plan, show what would move, and ask"),
        Binding("f6", "pause", "Pause", id="pause", tooltip="Stop after this pose; nothing is lost"),
        Binding("f7", "finish", "Finish", id="finish", tooltip="Seal the recording with what is there"),
        Binding("f8", "acknowledge", "Ack", id="acknowledge", tooltip="I looked: leave STOPPED or FAULT"),
        Binding("f9", "solve_newest", "Solve", id="solve", tooltip="Solve the session just recorded"),
        Binding("f3", "free_drive", "Hand", id="free-drive", tooltip="Free-drive: move the arm by hand"),
        Binding("f2", "record", "Take", id="record", tooltip="Take a picture here (free-drive)"),
        Binding("1", "switch_mode('live')", "Live", id="live", tooltip="The running capture"),
        Binding("2", "switch_mode('plan')", "Plan", id="plan", tooltip="All poses, their state and reasons"),
        Binding("3", "switch_mode('result')", "Result", id="result", tooltip="May it be trusted?"),
        Binding("4", "switch_mode('sessions')", "Sessions", id="sessions", tooltip="Past recordings"),
        Binding("5", "switch_mode('log')", "Log", id="log", tooltip="Everything that was said"),
        Binding("6", "switch_mode('checklist')", "Check", id="checklist", tooltip="Is everything there?"),
        Binding("f1", "show_help_panel", "Help", id="help", tooltip="Keys and help for what is on screen"),
        Binding("ctrl+q", "leave", "Quit", id="quit", tooltip="Close this screen; the daemon goes on"),
    ]
    status: reactive[StationStatus | None] = reactive(None)

    def __init__(self, connect: Connect) -> None:
        super().__init__()
        self._connect = connect
        self._link: Link | None = None
        self.result_path: str | None = None
        """The calibration file the result screen shows."""

    def on_mount(self) -> None:
        self.follow()
        self.fetch_previews()

    # --- the daemon → the screen ---

    @work(exclusive=True, group="follow", exit_on_error=False)
    async def follow(self) -> None:
        """Stays connected for as long as the screen lives."""
        while True:
            try:
                self._link = await self._connect()
                async for status in self._link.statuses():
                    self.post_message(StatusChanged(status))
            except (OSError, StationError):
                pass
            self._link = None
            self.post_message(StatusChanged(None))
            await asyncio.sleep(RECONNECT_S)

    @work(exclusive=True, group="preview", exit_on_error=False)
    async def fetch_previews(self) -> None:
        while True:
            await asyncio.sleep(PREVIEW_PERIOD_S)
            screen = self.screen
            if self._link is None or not isinstance(screen, LiveScreen):
                continue
            try:
                answer = await self._link.request("preview", width=480, height=384)
            except (OSError, StationError):
                continue
            if answer:
                screen.query_one(Preview).show(answer)

    def on_status_changed(self, message: StatusChanged) -> None:
        self.status = message.status
        for screen in self.screen_stack:
            if isinstance(screen, StationScreen) and screen.is_mounted:
                screen.show(message.status)

    def get_system_commands(self, screen: Screen[Any]) -> Iterable[SystemCommand]:
        """Every key's action by name too; what moves the arm asks the same question from here."""
        yield from super().get_system_commands(screen)
        for binding in (b for b in self.BINDINGS if isinstance(b, Binding)):
            action = binding.action
            yield SystemCommand(
                f"{binding.description} ({binding.key})",
                binding.tooltip,
                partial(self.call_later, self.run_action, action),
            )

    # --- the operator → the daemon ---

    async def ask(self, verb: Verb, **args: Any) -> Any:
        """The daemon's answer, or None after a notice that says why not."""
        if self._link is None:
            self.notify("No connection to the daemon: nothing was sent.", severity="error")
            return None
        try:
            return await self._link.request(verb, **args)
        except RefusedError as refused:
            self.notify(str(refused), severity="warning", timeout=10)
        except (OSError, StationError) as gone:
            self.notify(str(gone) or "The daemon is gone.", severity="error", timeout=10)
        return None

    @work(group="command", exit_on_error=False)
    async def send(self, verb: Verb, **args: Any) -> None:
        """A wish of one of the screens; control of the arm is taken with it."""
        if await self.ask("lease", action="take") is not None:
            await self.ask(verb, **args)

    @work(group="stop", exit_on_error=False)
    async def action_stop(self) -> None:
        await self.ask("stop")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_run(self) -> None:
        """Prepare, ask the person, go: the only way from a key to a motion."""
        if await self.ask("lease", action="take") is None:
            return
        resuming = self.status is not None and self.status.state is StationState.PAUSED
        answer = await self.ask("prepare", purpose="resume" if resuming else "run")
        if answer is None:
            return
        go = msgspec.convert(answer, GoSummary)
        if await self.push_screen_wait(ConfirmGo(go)):
            await self.ask("go", token=go.token)

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_pause(self) -> None:
        await self.ask("pause")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_finish(self) -> None:
        captured = self.status.session.captured if self.status else 0
        question = f"{captured} poses are captured. The recording is closed and can be solved."
        if await self.push_screen_wait(Confirm("Finish this session?", question, yes="Finish")):
            await self.ask("finish")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_free_drive(self) -> None:
        """The operator moves the arm with the pendant's free-drive button; the station only looks."""
        if self.status is None:
            return
        on = self.status.state is not StationState.FREE_DRIVE
        if await self.ask("lease", action="take") is not None:
            await self.ask("free_drive", on=on)

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_record(self) -> None:
        await self.ask("record")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_acknowledge(self) -> None:
        await self.ask("acknowledge")

    # --- results ---

    async def show_result(self, calibration: str) -> None:
        self.result_path = calibration
        await self.switch_mode("result")

    @work(exclusive=True, group="job", exit_on_error=False)
    async def solve(self, recording: str, folder: str) -> None:
        if (calibration := await offline.solve(self, recording, folder)) is not None:
            await self.show_result(calibration)

    def action_solve_newest(self) -> None:
        session = self.status.session if self.status is not None else None
        if session is None or not session.recording:
            self.notify("Nothing is sealed yet: F7 finishes a session; older ones are on screen 4.")
            return
        self.solve(session.recording, session.folder)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def recover(self, folder: str) -> None:
        await offline.recover(self, folder)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def install(self, calibration: str) -> None:
        await offline.install(self, calibration)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def export(self, calibration: str) -> None:
        await offline.export(self, calibration)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def discard(self, calibration: str) -> None:
        if await offline.discard(self, calibration):
            self.result_path = None
            await self.switch_mode("sessions")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_leave(self) -> None:
        running = self.status is not None and self.status.state not in (
            StationState.IDLE,
            StationState.DISCONNECTED,
        )
        text = "A session is running. Without this screen the arm decelerates and the session pauses."
        if not running or await self.push_screen_wait(Confirm("Close the screen?", text, yes="Close")):
            self.exit()


def run(socket: Path, who: str = "") -> None:
    """Opens the screen on the daemon that serves `socket` and returns when it is closed."""

    async def connect() -> Link:
        return await Client.connect(socket, who, interactive=True)

    StationApp(connect).run()
