"""A Universal Robots arm behind `devices.base.Robot`: one control process per approval, two ways to stop.

Everything here runs in one event loop and returns to it within milliseconds; the state stream has its own
thread, ur_rtde its own process. Rules: docs/operator/safety.md, faults: docs/contributor/fault-tests.md.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import time
from collections.abc import Coroutine, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from recordings.schema.messages import RobotState
from station.cell.acceptance import StopWay
from station.cell.config import ControlPath, RobotConfig
from station.cell.errors import RobotError, SafetyStopError, StaleStateError
from station.devices.base import fresh, ready
from station.devices.news import (
    RESTING_S,
    Evidence,
    longest_silence_s,
)
from station.devices.rtde import RuntimeState
from station.devices.ur_child import ControlChild
from station.devices.ur_condition import (
    APPROVE_AGAIN,
    foreign_program,
    not_powered,
    program_ended,
    program_not_running,
    program_replaced,
    safety_stop,
)
from station.devices.ur_control import LIBRARY_REMEDY
from station.devices.ur_dashboard import STOP, Dashboard, came
from station.devices.ur_link import UrLink, link_lost
from station.devices.ur_moves import MoveWatch, check_goal
from station.devices.ur_probe import SCRIPT_PORT, check_port

log = logging.getLogger(__name__)

POLL_S = 0.005
TOOL_S = 0.04
"""Between two looks at TCP and payload in a move: each takes the loop up to a millisecond."""
ONE_WAY_S = 1.0
RESTING_RAD_S = 0.005
STOP_WAIT_S = 0.05
OUTLIVED_S: dict[ControlPath, float] = {"ur_rtde": 0.3, "script": 0.6}
"""A program that still plays so long after a pause began did not stop for it. Our script plays until the arm
rests: at its fastest it brakes for 0.26 s."""
OUR_PROGRAMS = ("rtde_control", "station_control")
REPLACED_S = 0.1
"""A program that replaces ours plays so soon after ours ended."""
MAY_BE_REPLACED = ("program-ended", "watchdog", "off-path", "ended-short", "no-progress")
PROGRAM_START_NS = 200_000_000
LEFTOVER_WAIT_NS = 2_000_000_000
NEWS_WAIT_NS = 250_000_000
CLOSE_WAIT_S = 0.5


def control_path(config: RobotConfig) -> ControlPath:
    """Choose the control path: as configured, else ur_rtde where it is installed, else our own script."""
    return config.control or ("ur_rtde" if library_installed() else "script")


@cache
def library_installed() -> bool:
    """Looked up once: what drives an arm does not change under a running daemon."""
    return find_spec("rtde_control") is not None


def control_trouble(path: str) -> tuple[str, str]:
    """Say what speaks against driving an arm that way, and what to do; empty: nothing."""
    if path == "ur_rtde" and not library_installed():
        return "ur_rtde is not installed", LIBRARY_REMEDY
    return "", ""


class UrRobot(UrLink):
    """`log_dir`: where the control process's words go."""

    def __init__(self, config: RobotConfig, log_dir: Path) -> None:
        super().__init__(config)
        self.notice = ""
        """Notice to a person while a move is under way, though it is no fault; empty = nothing."""
        self._log_path = log_dir / "control.log"
        self._child: ControlChild | None = None
        self.control = False
        """The control program runs and obeys us."""
        self._moving = self._sent = False
        self._stop_reason = self._link_loss = ""
        self._ended_by: RobotError | None = None
        """What ended control between two moves."""
        self._one_way_s: float | None = None
        """When a stop test gave its one way (host monotonic); until then, and afterwards, None."""
        self._played_s = 0.0
        """When the control program was last seen playing (host monotonic)."""
        self._tool_looked_s = 0.0
        """When TCP and payload were last looked at in a move."""
        self._background: set[asyncio.Task[object]] = set()

    @property
    def control_path(self) -> ControlPath:
        return control_path(self.config)

    @property
    def control_pid(self) -> int | None:
        return self._child.pid if self._child is not None else None

    @property
    def in_motion(self) -> bool:
        return self._sent or super().in_motion

    async def start_control(self) -> None:
        """Spawns the control process, which loads its program; returns when that heard a first heartbeat.

        Only in answer to a motion approval. Raises RobotError.
        """
        if self._child is not None:
            raise RobotError("control is already started", code="control-started")
        self._stop_reason, self._ended_by = "", None
        await self.idle()  # a child that is still ending holds the registers
        await ready(self)
        await self._may_start()
        if why := self._why_stopped():
            raise _stopped(f" before control started{why}")
        child = self._child = ControlChild.spawn(self.config.host, self._log_path, self.control_path)
        try:
            tcp = await child.ready()
            if self._why_stopped():
                raise _stopped()
            if tcp is not None and self._tool is not None:
                self._tool.agree((tcp[0], tcp[1], tcp[2], tcp[3], tcp[4], tcp[5]))
            await self._heard(child)
        except BaseException as error:
            await self.end_control()
            if (why := self._why_stopped()) and isinstance(error, RobotError):
                raise _stopped(f" while control was starting{why}") from None
            raise
        self.control, self._played_s = True, time.monotonic()

    async def _heard(self, child: ControlChild) -> None:
        """Raises what kept the program from taking the first heartbeat."""
        try:
            await child.heard()
        except RobotError as error:
            raise await self._look_again(self._program_trouble(self.latest()) or error, child) from None

    async def _may_start(self) -> None:
        """Raises RobotError, with the remedy, while starting control would disturb somebody or must fail."""
        # A connection that was opened in local mode stays refused: e-Series want a new one.
        dashboard = await self.renew_dashboard()
        self.remote = await dashboard.remote()
        state = await fresh(self)
        if self.remote is False:
            raise _local_control()
        program = await dashboard.ask("programState")
        if self._primary is not None:
            self._primary.started = ""
        trouble = safety_stop(state) or not_powered(state) or foreign_program(state, program)
        if trouble is not None:
            raise trouble
        await check_port(self.config.host, SCRIPT_PORT)

    def heartbeat(self) -> None:
        """Called by the session loop at least every 50 ms while control lives; without it the arm stops."""
        if self._child is not None:
            self._child.beat()

    async def end_control(self) -> None:
        """Stops the script and ends the child."""
        child, self._child, self.control = self._child, None, False
        if child is None:
            return
        await child.end()
        await self._stop_leftover_program()

    async def move(self, joints_rad: Sequence[float], speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Moves the joints and returns when arrived. Whatever else ends it stops the arm and control.

        Raises RobotError, SafetyStopError, StaleStateError. Paths are checked by the planner; here only the
        caps on speed, acceleration and joint range are kept.
        """
        check_goal(joints_rad, speed_rad_s, acceleration_rad_s2, self.model.joint_limit_rad)
        child = self._child
        if child is None or not self.control:
            raise self._ended_by or RobotError(
                f"control is not started{self._why_stopped()}",
                code="no-control",
                remedy="Approve motion first.",
            )
        if self._moving:
            raise RobotError("a move is already under way", code="moving")
        self._moving, self._link_loss = True, ""
        try:
            await self._ready_to_move(child)
            sample = self.newest()
            watch = MoveWatch(sample.state.joints_rad, joints_rad, sample.operation, time.monotonic())
            self._sent = True
            await self._follow(watch, child, child.move(joints_rad, speed_rad_s, acceleration_rad_s2))
        except BaseException as error:
            cause = self._explain(error, child)
            try:
                await self._one_way_ends()
            finally:
                await asyncio.shield(self.stop(str(cause) or type(cause).__name__))
            raise await self._look_again(cause, child) from None
        finally:
            self._moving = self._sent = False
            self.notice, self._one_way_s = "", None

    async def _ready_to_move(self, child: ControlChild) -> None:
        """Returns with current news of an arm that may move and a heartbeat that was just heard."""
        while True:
            await ready(self)
            await child.heard()
            if self._child is not child:
                raise _stopped()  # while we waited
            if self.check() is not None:
                return

    async def _follow(
        self, watch: MoveWatch, child: ControlChild, sending: Coroutine[object, object, None]
    ) -> None:
        """Sends the move and watches it until the arm arrived."""
        sent = asyncio.ensure_future(sending)
        try:
            while not await self._step(watch, child, sent):
                await asyncio.sleep(POLL_S)
        finally:
            sent.cancel()

    async def _step(self, watch: MoveWatch, child: ControlChild, sent: asyncio.Future[None]) -> bool:
        """True when the arm arrived."""
        if self._stop_reason:
            raise _stopped(f": {self._stop_reason}")
        if sent.done():
            sent.result()
        self.news()
        sample = self.newest()
        self._note_playing(sample.state)
        if watch.step(sample.state, sample.operation, time.monotonic()) and sent.done():
            return True
        if (now_s := time.monotonic()) > self._tool_looked_s + TOOL_S:
            self._tool_looked_s = now_s
            self.check_tool(sample)
        child.check()
        self.notice = watch.notice
        return False

    def _explain(self, error: BaseException, child: ControlChild) -> BaseException:
        """The cause behind a symptom, as far as it is known at once: STOP first, then safety, the link."""
        if not isinstance(error, RobotError):
            return error
        if self._stop_reason:
            return _stopped(f": {self._stop_reason}")
        reader = self.reader
        state = reader.newest.state if reader is not None and reader.newest is not None else None
        stop = safety_stop(state) or not_powered(state) if state is not None else None
        if stop is not None:
            return stop
        if self._link_loss:  # the link may be on its way back already
            return link_lost(self._link_loss)
        child.read_waiting()  # its last words say when it kicked; after the stop there are no more
        return error

    async def _look_again(self, error: BaseException, child: ControlChild) -> BaseException:
        """What only news tell that come after the stop: a safety stop, the arm's power, the switch to local
        control, and what was late when the watchdog or late news ended the program."""
        if not isinstance(error, RobotError) or isinstance(error, SafetyStopError):
            return error
        now_ns, late = time.monotonic_ns(), error.code == StaleStateError.code
        ended = error.code in ("program-ended", "watchdog")
        if late or ended:
            state = await self._state_after(now_ns, round(RESTING_S * 1e9) if late else NEWS_WAIT_NS)
            if state is not None and (held := safety_stop(state) or not_powered(state)) is not None:
                return held
            if state is not None or not late:
                error = self._evidence(child, late).error() or error
        if self.remote and self.dashboard is not None:
            with contextlib.suppress(RobotError, TimeoutError):
                async with asyncio.timeout(0.3):
                    self.remote = await self.dashboard.remote()
        if self.remote is False:
            return _local_control()
        wait_s = REPLACED_S if ended else 0.0
        other = await self._other_program(wait_s) if error.code in MAY_BE_REPLACED else None
        if other is not None:
            return program_replaced(other)
        return program_ended(RuntimeState.STOPPED) if error.code == "watchdog" else error

    def _evidence(self, child: ControlChild, late: bool) -> Evidence:
        """What was late before the control program ended, or (`late`) since its last news."""
        states = self.reader.history.copy() if self.reader is not None else ()
        ended = (s for s in states if s.runtime_state != RuntimeState.PLAYING)
        after_s = (s.stamps.host_monotonic_ns / 1e9 for s in ended)
        now_s = time.monotonic()
        until_s = now_s if late else next((t for t in after_s if t > self._played_s), now_s)
        since_s = (self._played_s if late else until_s) - OUTLIVED_S[self.control_path]
        silence_s = 0.0 if late else longest_silence_s(child.kicks_s, since_s, until_s)
        return self.evidence(silence_s, since_s, until_s)

    async def _other_program(self, wait_s: float) -> str | None:
        """Name of another program that began to play since ours was last seen playing; '' if it has none.

        None: none did. It may have been ended by our own stop already.
        """
        give_up_s = time.monotonic() + wait_s
        while True:
            name = self._primary.started if self._primary is not None else ""
            if name and name not in OUR_PROGRAMS:
                return name
            if not name and self._plays_again():
                return ""
            if time.monotonic() > give_up_s:
                return None
            await asyncio.sleep(POLL_S)

    def _plays_again(self) -> bool:
        """A program stopped and one played since ours was last seen playing."""
        states = self.reader.history.copy() if self.reader is not None else ()
        since = [s.runtime_state for s in states if s.stamps.host_monotonic_ns > self._played_s * 1e9]
        return RuntimeState.STOPPED in since and since[-1] == RuntimeState.PLAYING

    async def stop(self, reason: str) -> None:
        """Decelerates now, by both paths; idempotent, in any state, never raises. Control ends with it.

        Without control of ours the dashboard's stop is sent all the same: it ends a foreign program too.
        """
        self._stop_reason = self._stop_reason or reason
        child, self._child, self.control = self._child, None, False
        reply: asyncio.Future[str] | None = None
        try:
            if child is not None:
                child.stop()
            if self.dashboard is not None and self.dashboard.alive:
                reply = self.dashboard.send(STOP)
        except Exception:
            log.exception("a path of the stop failed")
        self._later(self._finish_stop(child, reply))  # whatever failed above
        both = (reply, child.stop_acknowledged if child is not None else None)
        if waits := [w for w in both if w is not None]:
            await asyncio.wait(waits, timeout=STOP_WAIT_S)

    def stop_one_way(self, way: StopWay) -> None:
        """Ends the move under way by one way alone: the others follow at rest, or after `ONE_WAY_S`.

        For a stop test. STOP, a lost lease and a fault of the session use all ways at once, then too.
        """
        child = self._child
        if child is None:
            raise RobotError("control has ended", code="no-control")
        if way is StopWay.KILLED:
            os.kill(child.pid, signal.SIGKILL)
            return
        self._one_way_s = time.monotonic()
        if way is StopWay.CONTROL:
            child.stop()
        elif self.dashboard is not None and self.dashboard.alive:
            self.dashboard.send(STOP)
        else:
            raise RobotError("the dashboard is not connected", code="dashboard")

    async def _one_way_ends(self) -> None:
        """Waits for the rest of an arm that one way alone was to stop, but not for long."""
        while self._one_way_s is not None and time.monotonic() < self._one_way_s + ONE_WAY_S:
            await asyncio.sleep(POLL_S)
            try:
                if max(map(abs, self.latest().joint_speeds_rad_s)) < RESTING_RAD_S:
                    return
            except RobotError:
                return

    async def idle(self) -> None:
        """Returns when everything behind a stop is done: control ended, its process gone."""
        while self._background:
            await asyncio.wait(self._background)

    async def _finish_stop(self, child: ControlChild | None, reply: asyncio.Future[str] | None) -> None:
        """Behind the stop: the dashboard by a new connection if it did not answer, the end of the child."""
        answered = reply is not None and await came(reply, STOP_WAIT_S)
        ending = [child.end_after_stop(STOP_WAIT_S)] if child is not None else []
        if not answered:
            ending.append(self._dashboard_stop_anew())
        await asyncio.gather(*ending)
        if child is not None:
            await self._stop_leftover_program()

    async def _stop_leftover_program(self) -> None:
        """A killed child may have left its program playing, or one that it had just sent starts only now:
        it moves nothing, but it would look like somebody else's. Waits for news that is newer than this."""
        state = await self._state_after(time.monotonic_ns() + PROGRAM_START_NS, LEFTOVER_WAIT_NS)
        if state is not None and state.runtime_state == RuntimeState.PLAYING and self._child is None:
            await self._dashboard_stop_anew()

    async def _state_after(self, moment_ns: int, wait_ns: int) -> RobotState | None:
        """The first news that came after the moment (monotonic clock); None: none within `wait_ns` of it."""
        while time.monotonic_ns() < moment_ns + wait_ns:
            sample = self.reader.newest if self.reader is not None else None
            if sample is not None and sample.state.stamps.host_monotonic_ns > moment_ns:
                return sample.state
            await asyncio.sleep(POLL_S)
        return None

    async def _dashboard_stop_anew(self) -> None:
        try:
            dashboard = await Dashboard.open(self.config.host, timeout_s=1.0)
            try:
                await dashboard.ask(STOP)
            finally:
                await dashboard.close()
        except RobotError as error:
            log.warning("dashboard stop: %s", error)

    def on_link_lost(self, why: str) -> None:
        """ur_rtde would now reconnect by itself and load its program again: its process ends first."""
        self._link_loss = why
        if self._child is not None and not self._moving:
            self._later(self.stop(f"connection to the robot lost ({why})"))
        if self._child is not None:
            self._child.kill()

    async def supervise_more(self) -> None:
        """Between moves: a program, a process or a switch that failed ends control, and says why."""
        await super().supervise_more()
        child = self._child
        if child is None or not self.control or self._moving:
            return
        try:
            child.check()
            state = self.news()
            if state is not None and (trouble := self._program_trouble(state)) is not None:
                raise trouble
        except RobotError as error:
            cause = self._explain(error, child)
            await self.stop(str(cause))
            cause = await self._look_again(cause, child)
            assert isinstance(cause, RobotError)
            self._ended_by = cause
            raise cause from None
        if state is not None:
            self._note_playing(state)

    def _note_playing(self, state: RobotState) -> None:
        if state.runtime_state == RuntimeState.PLAYING:
            self._played_s = state.stamps.host_monotonic_ns / 1e9

    def _program_trouble(self, state: RobotState) -> RobotError | None:
        """Say what state and dashboard hold against the control program."""
        if self.remote is False:
            return _local_control()
        return safety_stop(state) or not_powered(state) or program_not_running(state)

    async def close(self) -> None:
        """Stops what moves, ends control and every connection."""
        if self._moving:
            await self.stop("the station is closing the robot")
        await self.end_control()
        if self._background:
            _, late = await asyncio.wait(self._background, timeout=CLOSE_WAIT_S)
            for task in late:
                task.cancel()
        await super().close()

    def _why_stopped(self) -> str:
        return f" ({self._stop_reason})" if self._stop_reason else ""

    def _later(self, work: Coroutine[object, object, object]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._background.add(task)
        task.add_done_callback(self._background.discard)


def _stopped(how: str = "") -> RobotError:
    return RobotError(f"stopped{how}", code="stopped")


def _local_control() -> RobotError:
    return RobotError(
        "the robot is in local control",
        code="local-control",
        remedy=f"Switch the pendant to Remote (top right), {APPROVE_AGAIN}.",
    )
