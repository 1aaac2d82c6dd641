"""What drives a Universal Robots arm: one control process per approval, two stop paths.

Runs in one event loop and never blocks it for more than milliseconds; the state stream has its own thread,
ur_rtde its own process. Rules: docs/operator/safety.md, faults: docs/contributor/fault-tests.md.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import time
from collections.abc import Callable, Coroutine, Sequence
from importlib.util import find_spec
from pathlib import Path

from recordings.schema.messages import RobotState
from station.cell.arm_acceptance import StopWay
from station.cell.config import ControlPath, RobotConfig
from station.cell.errors import RobotError
from station.cell.stillness import RESTING_RAD_S, fastest_rad_s
from station.devices.base import look_at, wait_for_state
from station.devices.news import CURRENT_S, MOVING_S, RESTING_S, Delay
from station.devices.rtde import RuntimeState
from station.devices.ur.child import ControlChild
from station.devices.ur.condition import arm_held, control_ended, foreign_program
from station.devices.ur.dashboard import STOP, STOPPED, Dashboard, DashboardError, came
from station.devices.ur.end_cause import cause_of_end
from station.devices.ur.link import UrLink
from station.devices.ur.moves import MoveWatch, check_goal
from station.devices.ur.probe import check_script_port
from station.devices.ur.state import link_lost
from station.devices.ur.stream import POLL_S

log = logging.getLogger(__name__)

TOOL_S = 0.04
"""Period of the checks of TCP and payload during a move; each takes up to a millisecond."""
ONE_WAY_S = 1.0
UNCONFIRMED_S = 0.5
"""A stop that the dashboard did not confirm counts as arrived after so long: without heartbeats the watchdog
ends the control program after 0.2 s, and the arm brakes from full speed in 0.26 s."""
STOP_WAIT_S = 0.05
PROGRAM_START_S = 0.2
UPLOADED_S = 1.0
"""Within this time after its upload a control program has started, or will not."""
LEFTOVER_WAIT_S = 2.0
CLOSE_WAIT_S = 0.5


def control_path(config: RobotConfig) -> ControlPath:
    """Choose the control path: as configured, else ur_rtde where it is installed, else our own script."""
    return config.control or ("ur_rtde" if library_installed() else "script")


def library_installed() -> bool:
    return find_spec("rtde_control") is not None


def control_trouble(path: str) -> tuple[str, str]:
    """Say why this control path cannot be used, and the remedy; both empty: it can."""
    if path == "ur_rtde" and not library_installed():
        missing = RobotError("ur-rtde-missing", reason="not found")
        return missing.text, missing.remedy
    return "", ""


class StopPaths:
    """Both ways by which a stop leaves, the control process and the dashboard, and when it had arrived.

    `link`: the arm's. `controlled` tells whether there is a control process now.
    """

    def __init__(self, link: UrLink, controlled: Callable[[], bool]) -> None:
        self._link = link
        self._controlled = controlled
        self._one_way_s: float | None = None
        """When the stop test triggered its single stop (host monotonic); None before and after it."""
        self._sent_s: float | None = None
        """When the newest stop of an arm that might have moved was sent (host monotonic); None: none was."""
        self._arrived_s: float | None = None
        """When the dashboard's answer to it came (host monotonic); None: not yet, or no stop was sent."""
        self._background: set[asyncio.Task[object]] = set()

    async def stop(self, child: ControlChild | None) -> None:
        """Stop the arm now by both ways, and end its control process `child`; never raises.

        The dashboard's `stop` is sent also without control: it ends another client's program, too.
        """
        reply: asyncio.Future[str] | None = None
        if child is not None or self._sent_s is None or not self._seen_at_rest():
            self._sent_s = time.monotonic()
            self._arrived_s = None
        dashboard = self._link.dashboard
        try:
            try:
                if child is not None:
                    child.stop()
            finally:
                if dashboard is not None and dashboard.alive:
                    reply = dashboard.send(STOP)
                    reply.add_done_callback(self._note_arrival)
        except Exception:
            log.exception("a path of the stop failed")
        self.later(self._finish_stop(child, reply))  # even if a path failed above
        both = (reply, child.stop_acknowledged if child is not None else None)
        if waits := [w for w in both if w is not None]:
            await asyncio.wait(waits, timeout=STOP_WAIT_S)

    def _seen_at_rest(self) -> bool:
        try:
            return fastest_rad_s(self._link.state()) < RESTING_RAD_S
        except RobotError:
            return False

    def _note_arrival(self, reply: asyncio.Future[str]) -> None:
        """Note when the dashboard answered that it had stopped the program."""
        answered = not reply.cancelled() and reply.exception() is None
        if answered and reply.result() == STOPPED and self._arrived_s is None:
            self._arrived_s = time.monotonic()

    def after_stop(self, state: RobotState) -> bool:
        """Tell whether a state was sampled, by the controller's clock, after the newest stop had arrived.

        The time of a sample is known within the clock's bound; its latest possible delay is taken off.
        """
        if self._sent_s is None:
            return True
        clock, stamps = self._link.clock(), state.stamps
        if clock is None:
            sampled_s = stamps.host_monotonic_ns / 1e9 - CURRENT_S
        else:
            bound_s = clock.bound_at(stamps.controller_s)
            sampled_s = clock.to_host_ns(stamps.controller_s) / 1e9 - bound_s
        if self._arrived_s is not None:
            return sampled_s > self._arrived_s
        return sampled_s > self._sent_s + UNCONFIRMED_S

    def stop_one_way(self, way: StopWay, child: ControlChild) -> None:
        """End the move by only one stop path, for a stop test; others follow at rest or after `ONE_WAY_S`.

        STOP, lost control and faults use all paths at once, also during a stop test.
        """
        if way is StopWay.KILLED:
            os.kill(child.pid, signal.SIGKILL)
            return
        self._one_way_s = time.monotonic()
        if way is StopWay.CONTROL:
            child.stop()
        elif self._link.dashboard is not None and self._link.dashboard.alive:
            self._link.dashboard.send(STOP)
        else:
            raise DashboardError(host=self._link.config.host, reason="not connected")

    async def one_way_ends(self) -> None:
        """Wait, at most `ONE_WAY_S`, until an arm that was stopped by one path alone rests."""
        while self._one_way_s is not None and time.monotonic() < self._one_way_s + ONE_WAY_S:
            await asyncio.sleep(POLL_S)
            try:
                if fastest_rad_s(self._link.state()) < RESTING_RAD_S:
                    return
            except RobotError:
                return

    def move_ended(self) -> None:
        """Note that a move is over, whatever ended it."""
        self._one_way_s = None

    async def idle(self) -> None:
        """Wait until a stop is completely carried out: control ended, its process gone."""
        while self._background:
            await asyncio.wait(self._background)

    async def _finish_stop(self, child: ControlChild | None, reply: asyncio.Future[str] | None) -> None:
        """Complete a stop: repeat the dashboard's on a new connection if it did not obey; end the child."""
        obeyed = reply is not None and await came(reply, STOP_WAIT_S) and reply.result() == STOPPED
        ending = [child.end_after_stop(STOP_WAIT_S)] if child is not None else []
        if not obeyed:
            ending.append(self._dashboard_stop_anew())
        await asyncio.gather(*ending)
        if child is not None:
            await self.stop_leftover_program(child)

    async def stop_leftover_program(self, child: ControlChild) -> None:
        """Stop a program that a killed child left playing, or that starts only now.

        It moves nothing, but would look like another client's. Waits for news newer than the kill; longer
        where the child was killed before its program was ready, as that may still be on its way.
        """
        look_s = time.monotonic() + PROGRAM_START_S
        until_s = look_s if child.started_s else look_s + UPLOADED_S
        while True:
            state = await self._link.states.state_after(look_s, LEFTOVER_WAIT_S)
            if state is None or self._controlled():
                return
            if state.runtime_state == RuntimeState.PLAYING:
                await self._dashboard_stop_anew()
                return
            if (look_s := time.monotonic()) > until_s:
                return

    async def _dashboard_stop_anew(self) -> None:
        try:
            dashboard = await Dashboard.open(self._link.config.host, timeout_s=1.0)
            try:
                if await dashboard.ask(STOP) == STOPPED and self._arrived_s is None:
                    self._arrived_s = time.monotonic()
            finally:
                await dashboard.close()
        except RobotError as error:
            log.warning("dashboard stop: %s", error)

    async def close(self) -> None:
        """Wait for what is still under way, with a limit."""
        if self._background:
            _, late = await asyncio.wait(self._background, timeout=CLOSE_WAIT_S)
            for task in late:
                task.cancel()

    def later(self, work: Coroutine[object, object, object]) -> asyncio.Task[object]:
        task = asyncio.get_running_loop().create_task(work)
        self._background.add(task)
        task.add_done_callback(self._background.discard)
        return task


class UrRobot:
    """What moves and stops a Universal Robots arm: a `Mover`; its `link` is the `Arm`.

    `log_dir`: folder for the control process's log.
    """

    def __init__(self, config: RobotConfig, log_dir: Path) -> None:
        """Raises ConfigError for an unknown model."""
        self.config = config
        self.link = UrLink(config, driver=self)
        self.stops = StopPaths(self.link, lambda: self._child is not None)
        self.control_path: str = control_path(config)
        self.control_trouble = control_trouble(self.control_path)
        self._log_path = log_dir / "control.log"
        self._child: ControlChild | None = None
        self.control = False
        """True while the control program runs on the robot and takes moves from this station."""
        self._moving = False
        self._watch: MoveWatch | None = None
        """The move under way, from when it is sent."""
        self._stop_reason = self._link_loss = ""
        self._ended_by: RobotError | None = None
        """Error that ended control between two moves."""
        self._explaining = False
        """True while that error's cause is being looked for."""
        self._tool_looked_s = 0.0
        """When TCP and payload were last checked during a move (host monotonic)."""

    @property
    def in_motion(self) -> bool:
        return self._watch is not None

    @property
    def notice(self) -> str:
        """Hint for people during a move that is no fault, such as a low speed slider; empty: none."""
        return self._watch.notice if self._watch is not None else ""

    @property
    def remote(self) -> bool | None:
        return self.link.remote

    @property
    def payload(self) -> tuple[float, ...]:
        return self.link.tool.payload

    async def start_control(self) -> None:
        """Start the control process, which loads its program; return when that took a first heartbeat.

        Call only after a motion approval. Raises RobotError.
        """
        if self._child is not None:
            raise RobotError("control-started")
        self._stop_reason, self._ended_by = "", None
        self.link.tool.relied_on = True
        await self.stops.idle()  # a child that is still ending keeps the registers
        await wait_for_state(self.link, checked=True)
        await self.may_start()
        if why := self._why_stopped():
            raise _stopped(f" before control started{why}")
        child = self._child = ControlChild.spawn(self.config.host, self._log_path, self.control_path)
        try:
            tcp = await child.ready()
            if self._why_stopped():
                raise _stopped()
            if tcp is not None:
                self.link.tool.agree((tcp[0], tcp[1], tcp[2], tcp[3], tcp[4], tcp[5]))
            await self._heard(child)
            # Older news are of an arm without a program: no move may be judged by them.
            await self.link.states.state_after(time.monotonic(), RESTING_S)
            if self._why_stopped():
                raise _stopped()
        except BaseException as error:
            await self.end_control()
            if (why := self._why_stopped()) and isinstance(error, RobotError):
                raise _stopped(f" while control was starting{why}") from None
            raise
        self.control = True

    async def _heard(self, child: ControlChild) -> None:
        """Wait for the program's first heartbeat; raise the reason why it was not taken."""
        try:
            await child.heard()
        except RobotError as error:
            trouble = self._program_trouble(self.link.state()) or error
            raise await cause_of_end(self.link, child, trouble) from None

    async def may_start(self) -> None:
        """Check that control can be started without replacing a program; else RobotError with remedy."""
        # e-Series controllers keep refusing commands on a connection that was opened in local mode.
        dashboard = await self.link.renew_dashboard()
        self.link.remote = await dashboard.remote()
        state = await wait_for_state(self.link)
        if self.link.remote is False:
            raise RobotError("local-control")
        _, _, program = (await dashboard.ask("programState")).partition(" ")
        self.link.tool.forget_program()
        if (trouble := arm_held(state) or foreign_program(state, program)) is not None:
            raise trouble
        await check_script_port(self.config.host)

    def heartbeat(self) -> None:
        """Keep the arm's watchdog from stopping it: call at least every 50 ms while control is started."""
        if self._child is not None:
            self._child.beat()

    async def end_control(self) -> None:
        """Stop the control program and end its process. What ended it before is no trouble any more."""
        child, self._child, self.control = self._child, None, False
        if self._ended_by is not None:
            self.link.forget_trouble(self._ended_by)
        if child is not None:
            await asyncio.shield(self.stops.later(self._end(child)))

    async def _end(self, child: ControlChild) -> None:
        await child.end()
        await self.stops.stop_leftover_program(child)

    async def move(self, joints_rad: Sequence[float], speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Move the joints; return on arrival. Any other end of the move stops the arm and ends control.

        Raises RobotError, SafetyStopError, StaleStateError. The planner checks paths; here only the limits of
        speed, acceleration and joint range are enforced.
        """
        check_goal(joints_rad, speed_rad_s, acceleration_rad_s2, self.link.model.joint_limit_rad)
        while self._explaining:
            await asyncio.sleep(POLL_S)
        child = self._child
        if child is None or not self.control:
            raise self._ended_by or RobotError("control-not-started", why=self._why_stopped())
        if self._moving:
            raise RobotError("moving")
        self._moving, self._link_loss = True, ""
        try:
            await self._ready_to_move(child)
            sample = self.link.states.sample(MOVING_S)
            watch = MoveWatch(sample.state.joints_rad, joints_rad, sample.operation, time.monotonic())
            self._watch = watch
            await self._follow(watch, child, child.move(joints_rad, speed_rad_s, acceleration_rad_s2))
        except BaseException as error:
            cause = self._known_cause(error) if isinstance(error, RobotError) else error
            try:
                await self.stops.one_way_ends()
            finally:
                await asyncio.shield(self.stop(str(cause) or type(cause).__name__))
            if isinstance(cause, RobotError):
                cause = await cause_of_end(self.link, child, cause)
                # Without a connection nothing resets the watchdog, which looks as if this computer was late.
                if self._link_loss and cause.code in set(Delay):
                    cause = link_lost(self._link_loss)
            raise cause from None
        finally:
            self._moving, self._watch = False, None
            self.stops.move_ended()

    async def _ready_to_move(self, child: ControlChild) -> None:
        """Wait until the state is current, the arm may move, and the control process heard a heartbeat."""
        while True:
            await wait_for_state(self.link, checked=True)
            await child.heard()
            if self._child is not child:
                raise _stopped()  # the arm was stopped during the wait
            if look_at(self.link, checked=True) is not None:
                return

    async def _follow(
        self, watch: MoveWatch, child: ControlChild, sending: Coroutine[object, object, None]
    ) -> None:
        """Send the move and watch it until the arm has arrived."""
        sent = asyncio.ensure_future(sending)
        try:
            while not await self._step(watch, child, sent):
                await asyncio.sleep(POLL_S)
        finally:
            sent.cancel()

    async def _step(self, watch: MoveWatch, child: ControlChild, sent: asyncio.Future[None]) -> bool:
        """Check the move once; True when the arm has arrived."""
        if self._stop_reason:
            raise _stopped(f": {self._stop_reason}")
        if sent.done():
            sent.result()
        sample = self.link.states.sample(MOVING_S)
        if watch.step(sample.state, sample.operation, time.monotonic()) and sent.done():
            return True
        if (now_s := time.monotonic()) > self._tool_looked_s + TOOL_S:
            self._tool_looked_s = now_s
            self.link.tool.check(sample)
        child.check()
        return False

    def _known_cause(self, error: RobotError) -> RobotError:
        """Name STOP or a lost connection, even if it is back by now, in place of what followed from it."""
        if self._stop_reason:
            return _stopped(f": {self._stop_reason}")
        return link_lost(self._link_loss) if self._link_loss else error

    async def stop(self, reason: str) -> None:
        """Decelerate now, by both ways out, and end control; idempotent, in any state, never raises.

        How STOP comes here: `protocol.stop_client`.
        """
        self._stop_reason = self._stop_reason or reason
        child, self._child, self.control = self._child, None, False
        await self.stops.stop(child)

    def after_stop(self, state: RobotState) -> bool:
        return self.stops.after_stop(state)

    def stop_one_way(self, way: StopWay) -> None:
        if self._child is None:
            raise RobotError("control-not-started", why="")
        self.stops.stop_one_way(way, self._child)

    def on_link_lost(self, why: str) -> None:
        """End the control process at once: ur_rtde would reconnect by itself and load its program again."""
        self._link_loss = why
        if self._child is not None and not self._moving:
            self.stops.later(self.stop(f"connection to the robot lost ({why})"))
        if self._child is not None:
            self._child.kill()

    async def supervise(self) -> None:
        """Between moves, end control when program or process ended or local control is on, and keep why."""
        child = self._child
        if child is None or not self.control or self._moving:
            return
        try:
            child.check()
            state = look_at(self.link)
            if state is not None and (trouble := self._program_trouble(state)) is not None:
                raise trouble
        except RobotError as error:
            self._explaining = True
            try:
                cause = self._known_cause(error)
                await self.stop(str(cause))
                self._ended_by = await cause_of_end(self.link, child, cause)
            finally:
                self._explaining = False
            raise self._ended_by from None

    def _program_trouble(self, state: RobotState) -> RobotError | None:
        """Find what is wrong with the control program by state and dashboard; None: nothing."""
        if self.link.remote is False:
            return RobotError("local-control")
        return control_ended(state)

    async def close(self) -> None:
        """Stop the arm and end control: the link closes this first."""
        if self._moving:
            await self.stop("the station is closing the robot")
        await self.end_control()
        await self.stops.close()

    def _why_stopped(self) -> str:
        return f" ({self._stop_reason})" if self._stop_reason else ""


def _stopped(how: str = "") -> RobotError:
    return RobotError("stopped", how=how)
