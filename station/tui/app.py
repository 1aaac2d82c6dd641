"""The operator's screen: a client that shows the daemon's status and sends the operator's wishes.

Nothing is kept here: closing or killing it, or losing ssh, loses only control of the arm, and the daemon
then decelerates the arm and pauses.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from textual import events, work
from textual.binding import Binding, BindingType

from calibrate.handeye.metrics import FEWEST_TO_SOLVE
from station.cell.errors import StationError
from station.cell.status import MotionPreview, SessionStatus, StationState, StationStatus
from station.operate.motion import PREPARE_S, prepared_motion
from station.protocol import verbs
from station.protocol.client import Client
from station.protocol.states import RUNNING
from station.protocol.verbs import PreviewImage, Purpose
from station.tui.capture_screen import CaptureScreen
from station.tui.connect import ConnectScreen
from station.tui.daemon_link import SILENT_S, DaemonApp, DaemonLink, TerminalWatch
from station.tui.dialogs import Confirm, ConfirmFinish, ConfirmMotion
from station.tui.frame import Question
from station.tui.help import Help
from station.tui.jobs import check_drift, solve_session
from station.tui.live_page import SIDE_PX, LivePageApp, news_of
from station.tui.log_screen import LogScreen
from station.tui.plan_screen import NEW_PLAN, PlanScreen
from station.tui.result import ResultScreen
from station.tui.screen import StationScreen
from station.tui.sessions import SessionsScreen
from station.tui.stop_key import run_behind_stop_key
from station.tui.task import DIGITS, STEPS, too_few
from station.tui.widgets.preview import PreviewPane, sharp_widget

PREVIEW_PERIOD_S = 0.25
LIVE_PERIOD_S = 0.1
"""Between two pictures for a browser while the arm rests."""
HELD = "The arm works by this screen. Closing it stops the arm at once and pauses the session."


SCREENS: tuple[type[StationScreen], ...] = (
    ConnectScreen,
    PlanScreen,
    CaptureScreen,
    ResultScreen,
    SessionsScreen,
    LogScreen,
)


class StationApp(LivePageApp[None], DaemonApp):
    """One app, several screens; the same keys everywhere.

    Screens are drawn from `known` alone. What they ask for goes to the daemon by `daemon`.
    """

    ENABLE_COMMAND_PALETTE = False  # in its place: `Help`
    TITLE = "Calibration station"
    CSS_PATH = "station.tcss"
    MODES: ClassVar[dict[str, type[StationScreen]]] = {screen.MODE: screen for screen in SCREENS}  # type: ignore[assignment]
    DEFAULT_MODE = "capture"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f12", "stop", "STOP", show=False, priority=True, tooltip="Stop the arm now"),
        Binding("f5", "run", "Run", tooltip="Plan if there is no plan, show the motion, and ask"),
        Binding("f6", "ask('pause')", "Pause", tooltip="Stop after this pose"),
        Binding("f7", "finish", "Finish", tooltip="Finish with the poses so far"),
        Binding("f8", "acknowledge", "Acknowledge", priority=True, tooltip="Look; then leave STOPPED, FAULT"),
        Binding("f9", "solve_newest", "Solve", tooltip="Solve the session just recorded"),
        Binding("f3", "freedrive", "By hand", tooltip="Begin or end capture by hand"),
        Binding("f2", "ask('record')", "Image", tooltip="Capture an image here (by hand)"),
        Binding(
            "o", "open_live", "Live picture", show=False, tooltip="The live picture, large, in a browser"
        ),
        *(
            Binding(
                DIGITS[s.MODE],
                f"switch_mode('{s.MODE}')",
                s.MODE.title(),
                show=s.MODE not in STEPS,  # the rail names these
                tooltip=s.TIP,
            )
            for s in SCREENS
        ),
        Binding("ctrl+q", "quit", "Quit", show=False, tooltip="Close this screen; the daemon goes on"),
    ]

    def __init__(self, client: Client) -> None:
        super().__init__()
        self.link = DaemonLink(self, client)
        self.terminal_watch = TerminalWatch(self.link)
        self._look = asyncio.Event()
        self._asked: tuple[object, ...] | None = None
        """What results and sessions depended on when they were asked for; None: they must be asked for."""
        self._greeted = False

    def on_mount(self) -> None:
        self.run_worker(self.link.follow(), group="follow", exit_on_error=False)
        self.fetch_previews()
        self.follow_results()
        self.terminal_watch.begin()

    def on_cursor_position(self, event: events.CursorPosition) -> None:
        self.terminal_watch.answered()

    # --- what is known ---

    @work(exclusive=True, group="preview", exit_on_error=False)
    async def fetch_previews(self) -> None:
        """Fetch camera images while a screen shows them, no larger than it can show."""
        while True:
            await asyncio.sleep(PREVIEW_PERIOD_S)
            for preview in self.screen.query(PreviewPane):
                with contextlib.suppress(OSError, StationError):
                    await preview.fetch(self.link.client)

    @work(exclusive=True, group="live page", exit_on_error=False)
    async def action_open_live(self) -> None:
        """Open the live page, and feed it for as long as a browser asks."""
        if (page := self.open_live_page()) is None:
            return
        picture = PreviewImage()
        while True:
            await asyncio.sleep(PREVIEW_PERIOD_S if self.known.works else LIVE_PERIOD_S)
            if page.watched:
                with contextlib.suppress(OSError, StationError):
                    picture = await self.link.client.call(verbs.Preview(SIDE_PX, SIDE_PX), timeout_s=SILENT_S)
                page.publish(news_of(self.known, picture))

    def hear(self, status: StationStatus | None, why: str = "") -> None:
        before = self.known.live
        if status is None:
            self.known = replace(self.known, gone=why, silent_s=None)
            return
        self.known = replace(self.known, status=status, gone="", own_id=self.link.client.own_id)
        if before is None or before.session.recording != status.session.recording:
            self.look_at_results()
        elif not self.known.works and self._depends_on(status) != self._asked:
            self._look.set()
        if before is not None and status.session.name not in ("", before.session.name):
            self.result_session = ""  # another session began: what was looked at is no part of it
        elif self.known.hand_guided and before is not None and _one_more(before.session, status.session):
            self.bell()
        if before is None:  # connected, perhaps to another daemon than before
            self.known = replace(self.known, configuration=self.link.client.config)
            lost = status.state is StationState.DISCONNECTED and status.source != "playback"
            if lost and not self._greeted:
                self.switch_mode("connect")
            self._greeted = True
            if not self.known.works:
                self.action_look_at_checks()

    @work(exclusive=True, group="checks", exit_on_error=False)
    async def action_look_at_checks(self) -> None:
        if (checks := await self.link.ask(verbs.Doctor())) is not None:
            self.known = replace(self.known, checks=tuple(checks))

    def watch_result_session(self) -> None:
        self.look_at_results()

    def look_at_results(self) -> None:
        """Ask for the result and the sessions, also while the arm works."""
        self._asked = None
        self._look.set()

    def _depends_on(self, status: StationStatus) -> tuple[object, ...]:
        """List what the shown result and the list of sessions depend on, changes by other programs too."""
        session = status.session
        return (
            self.result_session,
            session.name,
            session.recording,
            session.check,
            status.checked.recording,
            status.results,
        )

    @work(group="results", exit_on_error=False)
    async def follow_results(self) -> None:
        """Ask for what was solved, installed or recorded, by whomever; a daemon at work is left in peace."""
        while True:
            await self._look.wait()
            self._look.clear()
            live = self.known.live
            if live is not None and (self._asked is None or not self.known.works):
                self._asked = self._depends_on(live)
                await self.link.attempt(self._read_results())

    async def _read_results(self) -> None:
        result = await self.link.result(self.result_session)
        self.known = replace(self.known, result=result)
        sessions = await self.link.sessions()
        self.known = replace(self.known, sessions=sessions)

    # --- what the screens ask for by a key ---

    @work(exclusive=True, group="job", exit_on_error=False)
    async def action_solve_newest(self) -> None:
        session = self.known.shown.session
        if session.recording and session.captured < FEWEST_TO_SOLVE:
            way = "F3 takes views by hand." if self.known.shown.robot.by_hand else "F5 captures again."
            self.notify(f"{too_few(session.captured)} {way} Older sessions are on 5.", severity="warning")
        elif session.recording:
            await solve_session(self.link, session.recording, session.folder)
        else:
            self.notify("Nothing is finished yet: F7 finishes a session; older ones are on 5.")

    @work(exclusive=True, group="drift", exit_on_error=False)
    async def action_drift_check(self) -> None:
        await check_drift(self.link, self.approves)

    # --- keys ---

    async def approves(self, preview: MotionPreview) -> bool:
        """Show the motion and ask; the arm moves after this question only."""
        return await self.link.ask_person(ConfirmMotion(preview))

    async def plans_here(self, refusal: StationError) -> bool:
        """Offer to plan again from where the arm stands."""
        return await self.link.ask_person(Confirm("Plan again from here?", refusal.text, yes="Plan"))

    @work(group="stop", exit_on_error=False)
    async def action_stop(self) -> None:
        await self.link.stop()

    @work(exclusive=True, group="run", exit_on_error=False)
    async def action_run(self) -> None:
        """Start the plan, made now where there is none, or go on with a session that is paused."""
        status = self.known.live
        paused = status is not None and status.state is StationState.PAUSED
        unplanned = status is not None and not status.session.poses and not status.robot.by_hand
        if unplanned and await self.link.ask(NEW_PLAN, timeout_s=PREPARE_S) is None:
            return
        wanted = Purpose.RESUME if paused else Purpose.RUN
        begun = prepared_motion(
            self.link.client, verbs.Prepare(wanted), self.approves, plans_here=self.plans_here
        )
        if await self.link.start(begun):
            await self.switch_mode("capture")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_ask(self, verb: str) -> None:
        """Send a request that has no arguments, by its name."""
        await self.link.ask(verbs.VERBS[verb]())

    @work(exclusive=True, group="finish", exit_on_error=False)
    async def action_finish(self) -> None:
        live = self.known.live
        if live is not None and (refusal := verbs.Finish.refusal(live.state)) is not None:
            self.notify(str(refusal), severity="warning")
            return
        if await self.link.ask_person(ConfirmFinish()):
            await self.link.ask(verbs.Finish())

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_freedrive(self) -> None:
        """Capture by hand: the operator holds the pendant's freedrive button, the station only looks."""
        if (status := self.known.live) is None:
            return
        begins = not self.known.hand_guided
        if not begins and status.state in RUNNING:  # ends after the view that is being taken
            await self.link.ask(verbs.Pause())
        elif await self.link.ask(verbs.Freedrive(begins)) is not None and begins:
            await self.switch_mode("capture")

    @work(exclusive=True, group="command", exit_on_error=False)
    async def action_acknowledge(self) -> None:
        if await self.link.ask(verbs.Acknowledge()) is not None:
            self.clear_notifications()  # what they said of the stop is over

    @work(exclusive=True, group="quit", exit_on_error=False)
    async def action_quit(self) -> None:  # type: ignore[override]  # Textual awaits a worker, too
        held = self.known.works and self.link.has_control()
        if not held or await self.link.ask_person(Confirm("Close the screen?", HELD, yes="Close")):
            self.exit()

    @work(exclusive=True, group="help", exit_on_error=False)
    async def action_help(self) -> None:
        """Show help, and do what is chosen; an action of another screen is only led to."""
        under = self.screen
        if isinstance(under, Help) or (chosen := await self.link.ask_person(Help(under))) is None:
            return
        if chosen.mode in ("", self.current_mode) or isinstance(under, Question):
            await self.run_action(chosen.action, self.screen if chosen.mode else self)
            return
        await self.switch_mode(chosen.mode)
        self.notify(f"{chosen.key.split()[-1]}, here: {chosen.text}.", title=chosen.name, markup=False)


def _one_more(before: SessionStatus, now: SessionStatus) -> bool:
    """Tell whether a view was taken; those of another session were taken before."""
    return now.name == before.name and now.captured > before.captured


def run(socket: Path) -> None:
    """Open the screen on the daemon that serves `socket` and return when it is closed."""
    client = Client(socket)

    def show() -> None:
        PreviewPane.sharp = sharp_widget()
        StationApp(client).run()

    run_behind_stop_key(show, socket)
