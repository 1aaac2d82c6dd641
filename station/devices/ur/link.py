"""Read-only connection to an arm: identity, state stream, dashboard queries. Changes nothing on the robot.

Enough for capture in freedrive. A lost connection is reopened automatically, as reading is harmless.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Callable
from typing import Protocol

import msgspec

from calibrate.arms.kinematics import MODELS
from recordings.schema.messages import ArmKinematics, RobotIdentity, RobotState
from station.cell.clock_fit import ClockFit
from station.cell.config import RobotConfig
from station.cell.errors import RobotError, StaleStateError, StationError
from station.cell.layout import arm_model
from station.cell.status import ArmCondition
from station.devices.news import CURRENT_S, RESTING_S, is_loopback
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
from station.devices.ur.state import ArmState
from station.devices.ur.tool import Tool

log = logging.getLogger(__name__)

SUPERVISE_S = 0.2
RETRY_S = 0.5
STARTING = (RobotMode.NO_CONTROLLER, RobotMode.BOOTING)
"""Modes in which no tool is taken from an arm: it may state kinematics and TCP offset only later."""


class Driver(Protocol):
    """What moves the arm of a link: it is told what the link sees, and closed before it."""

    @property
    def in_motion(self) -> bool:
        """True from when a move is sent until its end."""

    @property
    def notice(self) -> str:
        """Hint for people during a move that is no fault; empty: none."""

    def on_link_lost(self, why: str) -> None:
        """Called once when the connection is lost."""

    async def supervise(self) -> None:
        """Called five times a second while the link is open. Raises StationError."""

    async def close(self) -> None: ...


class UrLink:
    """An arm that is read: an `Arm`. `driver`: what moves it; None: nothing of this station does."""

    def __init__(self, config: RobotConfig, driver: Driver | None = None) -> None:
        """Raises ConfigError for an unknown model."""
        self.config = config
        self.model = arm_model(config)
        self.identity = RobotIdentity(model=config.model)
        self.states = ArmState(config.host, lambda: self.in_motion)
        self.tool = Tool(config.host, self.model, config.kinematics is not None)
        self.dashboard: Dashboard | None = None
        self.remote: bool | None = None
        """Whether remote control is on; None where there is no such switch (CB3)."""
        self.guided = False
        """True while a person moves the arm by hand."""
        self._driver = driver
        self._lock: RobotLock | None = None
        self._trouble: RobotError | None = None
        self._trouble_since_s = 0.0
        """Since when it lasts (host monotonic)."""
        self._supervisor: asyncio.Task[None] | None = None

    @property
    def in_motion(self) -> bool:
        """True while the arm counts as in motion, when news may be late by less (`devices.news`)."""
        return self.guided or (self._driver is not None and self._driver.in_motion)

    @property
    def notice(self) -> str:
        return self._driver.notice if self._driver is not None else ""

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
        first = await self.states.open(self._on_link_lost)
        if first.state.robot_mode in STARTING and (starting := not_powered(first.state)) is not None:
            raise starting
        stated = await self.tool.open()
        if stated.tcp_offset is None:
            log.warning(
                "%s:30001 does not state the TCP offset; it is derived from the nominal kinematics", host
            )
        self.tool.take(first, stated)
        self.identity = RobotIdentity(
            model=self.config.model,
            serial=found.serial,
            controller_version=self.states.version,
            tcp_offset=self.tool.offset,
            payload_kg=self.tool.payload[0],
            arm_class=self.config.arm_class,
        )

    def _check_identity(self, found: Found) -> None:
        wanted = self.config
        host = self.config.host
        if found.model and found.model not in MODELS:
            raise unsupported_model(found.model, host)
        if found.model and found.model != wanted.model:
            raise RobotError("other-model", host=host, model=found.model, configured=wanted.model)
        if wanted.serial and found.serial and found.serial != wanted.serial:
            raise RobotError("other-robot", host=host, serial=found.serial, configured=wanted.serial)
        if self._lock is not None and found.serial != self.identity.serial:
            raise RobotError("robot-exchanged", host=host, serial=found.serial)
        self.remote = found.remote

    async def close(self) -> None:
        """Close the driver and every connection, and release the lock on the robot."""
        if self._driver is not None:
            await self._driver.close()
        if self._supervisor is not None:
            self._supervisor.cancel()
            await asyncio.gather(self._supervisor, return_exceptions=True)
            self._supervisor = None
        await self._close_link()
        self._unlock()
        self.tool.forget()
        self.states.forget()

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    async def _close_link(self) -> None:
        self.states.close()
        await self.tool.close()
        dashboard = self.dashboard
        self.dashboard = None
        if dashboard is not None:
            await dashboard.close()

    @property
    def kinematics(self) -> ArmKinematics | None:
        return self.tool.kinematics

    def subscribe(self, callback: Callable[[RobotState], None]) -> None:
        self.states.subscribe(callback)

    def state(self, largest_age_s: float = CURRENT_S) -> RobotState:
        return self.states.sample(largest_age_s).state

    def overdue(self) -> StaleStateError | None:
        return self.states.overdue()

    def at(self, host_monotonic_ns: int) -> RobotState:
        self.tool.relied_on = True
        return self.states.at(host_monotonic_ns)

    def clock(self) -> ClockFit | None:
        return self.states.clock()

    def delay(self, pause_s: float, since_s: float) -> StaleStateError | None:
        """Name what made a resting arm's news late since `since_s` (host monotonic); None: nothing did."""
        return self.states.evidence(pause_s, since_s, time.monotonic()).error(effect="")

    def check(self, state: RobotState) -> bool:
        """Tell whether the arm may be captured; False while a dashboard at rest is being asked again."""
        stop = safety_stop(state)
        if stop is not None:
            raise stop
        self.tool.check(self.states.sample(math.inf, connected=False))
        if self._trouble is not None:
            since_s = max(self._trouble_since_s, self.states.back_s)
            recent = time.monotonic() - since_s <= RESTING_S
            if self._trouble.code == DashboardError.code and recent and not self.in_motion:
                return False
            raise self._trouble
        return True

    def condition(self, state: RobotState) -> ArmCondition:
        return condition(state)

    def forget_trouble(self, trouble: RobotError) -> None:
        """Forget this trouble: what ended control before is none once control was ended."""
        if self._trouble is not None and self._trouble.data == trouble.data:
            self._trouble = None

    def _on_link_lost(self, why: str) -> None:
        log.warning("robot state of %s: %s", self.config.host, why)
        if self._driver is not None:
            self._driver.on_link_lost(why)

    async def _supervise(self) -> None:
        failed = False
        while True:
            await asyncio.sleep(RETRY_S if failed else SUPERVISE_S)
            failed = True
            reader = self.states.reader
            try:
                if reader is None or reader.ended is not None:
                    await self._close_link()
                    await self._open()
                await self.supervise()
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

    async def supervise(self) -> None:
        """Ask the dashboard what the state stream does not tell; then the driver. Raises StationError."""
        if self.dashboard is None or not self.dashboard.alive:
            await self.renew_dashboard()
        assert self.dashboard is not None
        self.tool.relied_on |= self.in_motion
        if self.tool.take_late_offset(self.state):
            self.identity = msgspec.structs.replace(self.identity, tcp_offset=self.tool.offset)
        if self.remote is not None:
            with contextlib.suppress(DashboardError):
                self.remote = await self.dashboard.remote()
        if self._driver is not None:
            await self._driver.supervise()
