"""Supervisor: heartbeat to the arm, monitoring of its link, status. Nothing in it may block.

The arm's watchdog and systemd's depend on this loop alone: when it stalls, the arm stops and the daemon is
restarted. So the heartbeat must not be sent from elsewhere.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import time
from collections import deque
from collections.abc import Callable

import msgspec

from recordings.schema.messages import RobotState
from station.cell.config import SPEED_CAP_M_S
from station.cell.errors import RobotError, SafetyStopError, StaleStateError
from station.cell.layout import cell_geometry
from station.cell.limits import point_speed_m_s
from station.cell.status import CameraStatus, RecorderStatus, RobotStatus, StationState, TriggerStatus
from station.devices.base import look_at
from station.devices.news import CURRENT_S, REPORTED_S, Delay
from station.protocol.states import RUNNING
from station.session.context import SessionContext
from station.session.threads import WATCH

DISK_PERIOD_S = 0.5
PAUSES = "pauses after this pose"
FINISHES = "finishes after this pose"


class Monitor:
    """Refreshes the status; `refresh` runs in the heartbeat's loop, so that nothing in it may block."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._not_accepted = ""
        moved = context.cell.mover is not None
        self._geometry = cell_geometry(context.cell.config) if moved else None

    def refresh(self) -> None:
        store, notice = self._context.store, self._context.cell.arm.notice
        if store.state is StationState.MOVING:
            store.update(reason=notice)  # such as 'speed slider at 5 %'
        store.update(
            robot=self._robot(),
            camera=self._camera(),
            trigger=self._trigger(),
            pending=self._pending(),
        )

    def _pending(self) -> str:
        """Name the request (pause, finish) that waits for the end of the pose under way."""
        context = self._context
        if context.store.state not in RUNNING:
            return ""
        return FINISHES if context.requests.finish else PAUSES if context.requests.pause_by else ""

    def _robot(self) -> RobotStatus:
        context, arm, mover = self._context, self._context.cell.arm, self._context.cell.mover
        shown = RobotStatus(
            identity=arm.identity,
            remote=mover.remote if mover else None,
            control_path=mover.control_path if mover else "",
            not_accepted=self._not_accepted,
            speed_limit_m_s=min(context.cell.config.limits.speed_m_s, SPEED_CAP_M_S),
            by_hand=mover is None,
            notice=arm.notice,
        )
        try:
            state = arm.state()
        except RobotError:
            return shown
        speed_m_s = 0.0
        if self._geometry is not None:
            speed_m_s = point_speed_m_s(self._geometry, state.joints_rad, state.joint_speeds_rad_s)
        return msgspec.structs.replace(
            shown,
            state=state,
            condition=arm.condition(state),
            speed_m_s=round(speed_m_s, 3),
            still=context.stillness.at_rest,
        )

    def _camera(self) -> CameraStatus:
        camera, shown = self._context.cell.camera, self._context.store.status.camera
        return CameraStatus(shown.identity, camera.counts(), camera.timing)

    def _trigger(self) -> TriggerStatus:
        shown, box = self._context.store.status.trigger, self._context.cell.trigger
        if box is None or not shown.identity:
            return shown
        return TriggerStatus(shown.identity, box.pulses)

    async def watch_files(self) -> None:
        """Read files for the daemon's life, in a thread: a hanging disk must not delay the heartbeat."""
        while True:
            free_bytes, self._not_accepted = await WATCH.run(_read_files, self._context)
            self._context.store.update(recorder=RecorderStatus(free_bytes))
            await asyncio.sleep(DISK_PERIOD_S)


def _read_files(context: SessionContext) -> tuple[int | None, str]:
    """Read free space in steps of 1 MB, None where it is gone, and why the arm is not accepted."""
    free_bytes = None
    with contextlib.suppress(OSError):
        free_bytes = shutil.disk_usage(context.root).free // 1_000_000 * 1_000_000
    return free_bytes, context.cell.acceptance_trouble(context.root)


TICK_S = 0.02
STATUS_TICKS = 5


class SessionSupervisor:
    def __init__(
        self,
        context: SessionContext,
        void_approvals: Callable[[], None],
        hold_latch: Callable[[str, str], None],
    ) -> None:
        """`hold_latch`: holds the session's latch, with reason and cause, without a change of state."""
        self._context = context
        self.monitor = Monitor(context)
        self._void_approvals = void_approvals
        self._hold_latch = hold_latch
        self._safety_stopped = False
        """The controller's own safety held the arm when its state was last seen."""
        self.before_round: Callable[[], None] = lambda: None
        """Called at the begin of every round: the daemon reads STOP's socket here, too."""
        self.after_round: Callable[[], None] = lambda: None
        """Called at the end of every round: the daemon pings systemd's watchdog."""
        self._lost_code = ""
        """Error code while the arm's states are later than allowed; empty: they are not."""
        self._late_since_s = 0.0
        """Since when states are late (host monotonic); 0: they are not."""
        self.lags_s: deque[float] = deque(maxlen=50)
        """Delay of each round of the last second."""

    async def run(self) -> None:
        """Run for the daemon's life; the session ends a defect in it as a fault."""
        due_s, number = time.monotonic(), 0
        while True:
            now_s = time.monotonic()
            self.lags_s.append(max(0.0, now_s - due_s))
            self._round(number)
            number += 1
            due_s = max(due_s + TICK_S, now_s + TICK_S / 2)
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))

    def _round(self, number: int) -> None:
        self.before_round()
        if self._context.store.state in RUNNING and (mover := self._context.cell.mover) is not None:
            mover.heartbeat()
        if number % STATUS_TICKS == 0:
            self._watch_link()
            self.monitor.refresh()
        self.after_round()

    def _watch_link(self) -> None:
        """Switch between idle and disconnected; during a run the run itself detects a lost robot."""
        store, arm = self._context.store, self._context.cell.arm
        try:
            state = look_at(arm)
        except StaleStateError as error:
            if not self._lost_code:
                self._void_approvals()
            new, self._lost_code = error.code != self._lost_code, error.code
            if store.state is StationState.DISCONNECTED:
                store.update(reason=str(error), cause=error.code)
            elif store.state is StationState.IDLE:
                store.enter(StationState.DISCONNECTED, error)
                store.problem(error, said="robot lost: {}")
            elif new and store.state is StationState.FREE_DRIVE:
                store.problem(error)
            return
        if state is None:
            self._late_since_s = self._late_since_s or time.monotonic()
            return
        self._lost_code = ""
        self._watch_safety(state)
        if self._late_since_s:
            self._report_delay(self._late_since_s)
            self._late_since_s = 0.0
        if store.state is StationState.DISCONNECTED:
            store.enter(self._context.resting)
            store.event("robot-connected", "robot connected")

    def _watch_safety(self, state: RobotState) -> None:
        """Bar services when the controller's safety stops an arm that rests.

        In a run the run itself ends as `stopped`.
        """
        cell, before = self._context.cell, self._safety_stopped
        if cell.mover is None:
            return
        try:
            cell.arm.check(state)
        except SafetyStopError as error:
            self._safety_stopped = True
            if not before:
                self._void_approvals()
                self._hold_latch(str(error), error.code)
            return
        except RobotError:
            return
        self._safety_stopped = False

    def _report_delay(self, since_s: float) -> None:
        """Report what made states of a resting arm late."""
        store, now_s = self._context.store, time.monotonic()
        late = self._context.cell.arm.delay(max(self.lags_s, default=0.0), since_s - REPORTED_S)
        now_ns, late_ns = time.time_ns(), round(1e9 * (now_s - since_s))
        recent = (e.code for e in store.status.events if 0 <= now_ns - e.wall_ns < late_ns)
        told = not set(Delay).isdisjoint(recent)
        if late is not None and now_s - since_s > REPORTED_S - CURRENT_S and not told:
            store.problem(late)
