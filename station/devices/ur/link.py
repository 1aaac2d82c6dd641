"""Read-only connection to an arm: identity, state stream, dashboard queries. Changes nothing on the robot.

Enough for capture in freedrive. A lost connection is reopened automatically, as reading is harmless.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Callable, Sequence

import msgspec

from calibrate.kinematics import MODELS
from recordings.schema.messages import ArmKinematics, RobotIdentity, RobotState
from station.cell.clock_fit import ClockFit
from station.cell.config import RobotConfig
from station.cell.errors import RobotError, StaleStateError, StationError
from station.cell.layout import arm_model
from station.cell.status import ArmCondition
from station.devices.history import state_at
from station.devices.news import CURRENT_S, MOVING_S, RESTING_S, Evidence, is_loopback, largest_gap
from station.devices.robot_lock import LOCKS, RobotLock
from station.devices.rtde import RobotMode
from station.devices.ur.condition import condition, not_powered, safety_stop
from station.devices.ur.dashboard import Dashboard, DashboardError
from station.devices.ur.probe import (
    Found,
    check_script_port,
    identify,
    open_dashboard,
    unsupported_model,
)
from station.devices.ur.state import POLL_S, Payload, Sample, StateReader
from station.devices.ur.tool import Installation, PrimaryReader, TcpCheck, check_payload

log = logging.getLogger(__name__)

SUPERVISE_S = 0.2
RETRY_S = 0.5
STARTING = (RobotMode.NO_CONTROLLER, RobotMode.BOOTING)
"""Modes in which no tool is taken from an arm: it may state kinematics and TCP offset only later."""


class UrLink:
    def __init__(self, config: RobotConfig) -> None:
        """Raises ConfigError for an unknown model."""
        self.config = config
        self.model = arm_model(config)
        self.remote: bool | None = None
        """Whether remote control is on; None where there is no such switch (CB3)."""
        self.reader: StateReader | None = None
        """Reader of the state stream, with its counters; a new one after a lost connection."""
        self._newest: Sample | None = None
        """The newest sample, of this connection or an earlier one; None: none."""
        self._arrived_ns = 0
        """Its arrival (host monotonic); 0: none."""
        self.guided = False
        """True while a person moves the arm by hand."""
        self.dashboard: Dashboard | None = None
        self._lock: RobotLock | None = None
        self.identity = RobotIdentity(model=config.model)
        self._subscribers: list[Callable[[RobotState], None]] = []
        self._primary: PrimaryReader | None = None
        self._tool: TcpCheck | None = None
        self._relied_on = False
        """A picture or a motion relies on the TCP offset taken at connect."""
        self._payload: Payload | None = None
        """The payload at connect."""
        self._trouble: RobotError | None = None
        self._trouble_since_s = 0.0
        """Since when the trouble lasts although states come (host monotonic)."""
        self._supervisor: asyncio.Task[None] | None = None

    @property
    def payload(self) -> tuple[float, ...]:
        """Mass (kg) and centre (m, in `flange`) at connect; empty: not reported."""
        return (self._payload.mass_kg, *self._payload.centre_m) if self._payload is not None else ()

    async def connect(self) -> RobotIdentity:
        """Read the identity and start the state stream; changes nothing on the robot. Raises RobotError."""
        if self._supervisor is not None:
            return self.identity
        if not self.config.host:
            raise RobotError("no-host")
        try:
            await self._open()
        except BaseException:
            await self._close_link()
            self._unlock()
            raise
        self._supervisor = asyncio.create_task(self._supervise(), name="robot supervisor")
        return self.identity

    async def _open(self) -> None:
        host = self.config.host
        found = await identify(await self.renew_dashboard())
        self._check_identity(found)
        if self._lock is None:
            simulated = is_loopback(host)  # these share a serial number, and any user may have one
            name = host if simulated or not found.serial else found.serial
            self._lock = RobotLock(name, None if simulated else LOCKS)
        await check_script_port(host)
        reader = self.reader = StateReader(host, self._deliver, self.on_link_lost)
        first = await reader.open()
        if first.state.robot_mode in STARTING and (starting := not_powered(first.state)) is not None:
            raise starting
        self._primary = PrimaryReader(host)
        installation = await self._primary.first()
        if installation.tcp_offset is None:
            log.warning(
                "%s:30001 does not state the TCP offset; it is derived from the nominal kinematics", host
            )
        self._adopt(found, first, reader, installation)

    def _check_identity(self, found: Found) -> None:
        wanted, host = self.config, self.config.host
        if found.model and found.model not in MODELS:
            raise unsupported_model(found.model, host)
        if found.model and found.model != wanted.model:
            raise RobotError("other-model", host=host, model=found.model, configured=wanted.model)
        if wanted.serial and found.serial and found.serial != wanted.serial:
            raise RobotError("other-robot", host=host, serial=found.serial, configured=wanted.serial)
        if self._lock is not None and found.serial != self.identity.serial:
            raise RobotError("robot-exchanged", host=host, serial=found.serial)
        self.remote = found.remote

    def _adopt(self, found: Found, first: Sample, reader: StateReader, installation: Installation) -> None:
        if self._payload is None:
            self._payload = first.payload
        if self._tool is None:
            self._tool = self._tool_of(first.state, installation)
        else:
            self._tool.check(first.state, installation)
        self.identity = RobotIdentity(
            model=self.config.model,
            serial=found.serial,
            controller_version=".".join(map(str, reader.version)),
            tcp_offset=self._tool.offset,
            payload_kg=self._payload.mass_kg,
        )

    def _tool_of(self, state: RobotState, installation: Installation) -> TcpCheck:
        return TcpCheck(self.model, self.config.kinematics is not None, state, installation)

    def _adopt_late_offset(self) -> None:
        """Take the TCP offset that the controller states after connecting, where nothing relies on ours."""
        told = self._primary.installation if self._primary is not None else Installation()
        if told.tcp_offset is None or self._tool is None or self._tool.stated or self._relied_on:
            return
        self._tool = self._tool_of(self.state(), told)
        self.identity = msgspec.structs.replace(self.identity, tcp_offset=self._tool.offset)

    async def close(self) -> None:
        """Close every connection and release the lock on the robot."""
        if self._supervisor is not None:
            self._supervisor.cancel()
            await asyncio.gather(self._supervisor, return_exceptions=True)
            self._supervisor = None
        await self._close_link()
        self._unlock()
        self._tool, self._payload, self._relied_on = None, None, False
        self._newest, self._arrived_ns = None, 0

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    async def _close_link(self) -> None:
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.close()
        primary, self._primary = self._primary, None
        if primary is not None:
            await primary.close()
        dashboard, self.dashboard = self.dashboard, None
        if dashboard is not None:
            await dashboard.close()

    def subscribe(self, callback: Callable[[RobotState], None]) -> None:
        """Call back with every state in order: the callback must be quick."""
        self._subscribers.append(callback)

    def _deliver(self, state: RobotState) -> None:
        before_ns, self._arrived_ns = self._arrived_ns, state.stamps.host_monotonic_ns
        if self.reader is not None:
            self._newest = self.reader.newest
        if self._arrived_ns - before_ns > CURRENT_S * 1e9:
            self._trouble_since_s = time.monotonic()  # what delayed the states delayed all else, too
        for callback in self._subscribers:
            try:
                callback(state)
            except Exception:
                log.exception("a subscriber of the robot's state failed and is dropped")
                self._subscribers = [s for s in self._subscribers if s is not callback]

    @property
    def kinematics(self) -> ArmKinematics | None:
        return None if self._tool is None else self._tool.kinematics

    @property
    def connected(self) -> bool:
        """True while the state stream is connected; how old its newest state is, tells `age_s`."""
        return self.reader is not None and self.reader.ended is None and self.reader.newest is not None

    @property
    def in_motion(self) -> bool:
        """True while the arm counts as in motion, when news may be late by less (`devices.news`)."""
        return self.guided

    def age_s(self) -> float:
        """Return the age of the newest sample whose controller time advanced.

        Waiting data are read first, so that a busy computer does not make news old.
        """
        if self.reader is not None and self._age_s() > CURRENT_S:
            self.reader.read()
        return self._age_s()

    def _age_s(self) -> float:
        return (time.monotonic_ns() - self._arrived_ns) / 1e9 if self._arrived_ns else float("inf")

    def sample(self, largest_age_s: float = CURRENT_S, *, connected: bool = True) -> Sample:
        """Return the newest sample; StaleStateError where it is older, or its controller time stands as long.

        `connected`: the connection must live; False: a sample of one that ended will do, too.
        """
        age_s = self.age_s()
        if self._newest is None or age_s > largest_age_s or (connected and not self.connected):
            raise self.stale(age_s, largest_age_s)
        return self._newest

    def state(self, largest_age_s: float = CURRENT_S) -> RobotState:
        return self.sample(largest_age_s).state

    def overdue(self) -> StaleStateError | None:
        """Name why a late state is waited for no longer: at once where the connection of an arm in motion
        ended."""
        limit_s = MOVING_S if self.in_motion else RESTING_S
        try:
            self.sample(limit_s, connected=self.in_motion)
        except StaleStateError as error:
            return error
        return None

    def delay(self, pause_s: float, since_s: float) -> StaleStateError | None:
        """Name what made a resting arm's news late since `since_s` (host monotonic); None: nothing did."""
        return self.evidence(pause_s, since_s, time.monotonic()).error(effect="")

    def evidence(self, pause_s: float, since_s: float, until_s: float) -> Evidence:
        """What was late in a span (host monotonic). `pause_s`: for how long this computer kicked nothing."""
        period_s = 1 / self.reader.rate_hz if self.reader is not None and self.reader.rate_hz else 0.0
        gap_s, clock_gap_s = largest_gap(self.states(), since_s, until_s, period_s)
        return Evidence(pause_s, gap_s, clock_gap_s, is_loopback(self.config.host))

    def stale(self, age_s: float, limit_s: float) -> StaleStateError:
        """Make the error that says why the newest state is too old."""
        reader = self.reader
        if reader is None or (reader.ended is None and reader.newest is None):
            return not_connected(self.config.host)
        if reader.ended is not None:
            return link_lost(reader.ended)
        if reader.not_finite:
            return StaleStateError("state-not-finite", age_s=age_s, limit_s=limit_s)
        cause, remedy = "", "Check cable and network."
        if reader.stands_still:
            cause, remedy = ": the controller's clock stands still", "Restart the controller."
        elif is_loopback(self.config.host):
            cause, remedy = ", which runs on this computer", "Reduce its load."
        return StaleStateError(age_s=age_s, limit_s=limit_s, cause=cause, advice=remedy)

    def at(self, host_monotonic_ns: int) -> RobotState:
        """Interpolate the state at a host time within the last 10 s; StaleStateError outside."""
        self._relied_on = True
        if self.reader is None:
            raise not_connected(self.config.host)
        return state_at(self.states(), self.clock(), host_monotonic_ns)

    def states(self) -> Sequence[RobotState]:
        """Return the states of the last 10 s, as far as this connection gave them."""
        return self.reader.history.copy() if self.reader is not None else ()

    async def state_after(self, moment_s: float, wait_s: float) -> RobotState | None:
        """Wait for a state younger than a moment (host monotonic); None: none within `wait_s` of it."""
        while time.monotonic() < moment_s + wait_s:
            with contextlib.suppress(StaleStateError):
                return self.sample(time.monotonic() - moment_s, connected=False).state
            await asyncio.sleep(POLL_S)
        return None

    @property
    def program_started(self) -> str:
        """Name of the program that started last, as far as the robot told."""
        return self._primary.started if self._primary is not None else ""

    def clock(self) -> ClockFit | None:
        """Return the controller's clock against the host's; None before there are enough samples."""
        return self.reader.clock.fit() if self.reader is not None else None

    def check(self, state: RobotState) -> bool:
        """Tell whether the arm may be captured; False while a dashboard at rest is being asked again."""
        stop = safety_stop(state)
        if stop is not None:
            raise stop
        self.check_tool(self.sample(math.inf, connected=False))
        if self._trouble is not None:
            recent = time.monotonic() - self._trouble_since_s <= RESTING_S
            if self._trouble.code == DashboardError.code and recent and not self.in_motion:
                return False
            raise self._trouble
        return True

    def condition(self, state: RobotState) -> ArmCondition:
        return condition(state)

    def check_tool(self, sample: Sample) -> None:
        """Raise RobotError when TCP or payload differ from those at connect; works in motion, too."""
        if self._tool is not None and self._primary is not None:
            self._tool.check(sample.state, self._primary.installation)
        if self._payload is not None:
            check_payload(sample.payload, self._payload)

    def on_link_lost(self, why: str) -> None:
        """Called once when the connection is lost; to be extended by the subclass that controls the arm."""
        log.warning("robot state of %s: %s", self.config.host, why)

    async def _supervise(self) -> None:
        failed = False
        while True:
            await asyncio.sleep(RETRY_S if failed else SUPERVISE_S)
            failed = True
            reader = self.reader
            try:
                if reader is None or reader.ended is not None:
                    await self._close_link()
                    await self._open()
                await self.supervise_more()
                failed, self._trouble = False, None
            except StationError as error:
                if self._trouble is None:
                    self._trouble_since_s = time.monotonic()
                self._trouble = RobotError.from_data(error.data)
            except Exception:
                log.exception("the robot's supervision failed; it goes on")

    async def renew_dashboard(self) -> Dashboard:
        """Replace the dashboard connection by a new one. Raises RobotError."""
        fresh = await open_dashboard(self.config.host)
        old, self.dashboard = self.dashboard, fresh
        if old is not None:
            await old.close()
        return fresh

    async def supervise_more(self) -> None:
        """Ask the dashboard what the state stream does not tell. Raises StationError."""
        if self.dashboard is None or not self.dashboard.alive:
            await self.renew_dashboard()
        assert self.dashboard is not None
        self._relied_on |= self.in_motion
        self._adopt_late_offset()
        if self.remote is not None:
            with contextlib.suppress(DashboardError):
                self.remote = await self.dashboard.remote()


def not_connected(host: str) -> StaleStateError:
    return StaleStateError("not-connected", host=host)


def link_lost(why: str) -> StaleStateError:
    return StaleStateError("link-lost", why=why)
