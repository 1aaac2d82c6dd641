"""Supervisor: heartbeat to the arm, monitoring of its link, status. Nothing in it may block.

The arm's watchdog and systemd's depend on this loop alone: when it stalls, the arm stops and the daemon is
restarted. So the heartbeat must not be sent from elsewhere.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable

from station.cell.errors import StaleStateError
from station.cell.status import StationState
from station.devices.news import CURRENT_S, TOLD_S, Delay
from station.protocol.states import RUNNING
from station.session.context import SessionContext
from station.session.monitor import Monitor

log = logging.getLogger(__name__)

TICK_S = 0.02
STATUS_TICKS = 5


class SessionSupervisor:
    def __init__(self, context: SessionContext, lost: Callable[[], None]) -> None:
        """`lost`: called when the arm's states are too late."""
        self._context = context
        self._monitor = Monitor(context)
        self._lost = lost
        self.first: Callable[[], None] = lambda: None
        """Called first in every round."""
        self.ticked: Callable[[], None] = lambda: None
        """Called after every round."""
        self._failure = ""
        self._silent = ""
        """Code of what is wrong while the robot's states are later than allowed; empty: they are not."""
        self._late_since_s = 0.0
        """Since when states are late (host monotonic); 0: they are not."""
        self.lags_s: deque[float] = deque(maxlen=50)
        """Delay of each round of the last second."""

    async def run(self) -> None:
        """Run for the daemon's life."""
        due_s, number = time.monotonic(), 0
        while True:
            now_s = time.monotonic()
            self.lags_s.append(max(0.0, now_s - due_s))
            self._round(number)
            number += 1
            due_s = max(due_s + TICK_S, now_s + TICK_S / 2)
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))

    def _round(self, number: int) -> None:
        self.first()
        if self._context.store.state in RUNNING and (mover := self._context.cell.mover) is not None:
            mover.heartbeat()
        if number % STATUS_TICKS == 0:
            self._look()
        self.ticked()

    def _look(self) -> None:
        """Refresh the status. An error is reported and does not end the heartbeat."""
        try:
            self._watch_link()
            self._monitor.refresh()
        except Exception as error:
            if repr(error) != self._failure:
                self._failure = repr(error)
                log.exception("the status could not be refreshed")
                self._context.store.problem(error, "error", said="what the screen shows is not fresh: {!r}")

    def lag_ms(self) -> float:
        """Return the largest delay of the last second, ms."""
        return 1000 * max(self.lags_s, default=0.0)

    def _watch_link(self) -> None:
        """Switch between idle and disconnected; during a run the run itself detects a lost robot."""
        store, robot = self._context.store, self._context.cell.robot
        try:
            if robot.news() is None:
                self._late_since_s = self._late_since_s or time.monotonic()
                return
        except StaleStateError as error:
            if not self._silent:
                self._lost()
            new, self._silent = error.code != self._silent, error.code
            if store.state is StationState.DISCONNECTED:
                store.update(reason=str(error), cause=error.code)
            elif store.state is StationState.IDLE:
                store.enter(StationState.DISCONNECTED, error)
                store.problem(error, said="robot lost: {}")
            elif new and store.state is StationState.FREE_DRIVE:
                store.problem(error)
            return
        self._silent = ""
        if self._late_since_s:
            self._tell_delay(self._late_since_s)
            self._late_since_s = 0.0
        if store.state is StationState.DISCONNECTED:
            store.enter(self._context.resting)
            store.event("robot-connected", "robot connected")

    def _tell_delay(self, since_s: float) -> None:
        """Report what made states of a resting arm late."""
        store, now_s = self._context.store, time.monotonic()
        late = self._context.cell.robot.delay(self.lag_ms() / 1000, since_s - TOLD_S)
        began_ns = time.time_ns() - round(1e9 * (now_s - since_s))
        told = any(event.code in set(Delay) and event.wall_ns > began_ns for event in store.status.events)
        if late is not None and now_s - since_s > TOLD_S - CURRENT_S and not told:
            store.problem(late)
