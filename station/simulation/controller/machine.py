"""The whole controller on one address: robot, clock and every port."""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Callable

from station.simulation.controller.dashboard import dashboard_service
from station.simulation.controller.network import Service
from station.simulation.controller.primary import script_services
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.rtde_server import RtdeServer
from station.simulation.controller.state import Journal, Settings

CHUNK = 25
"""Cycles run at once when behind; sockets are read in between."""
LATE_CYCLES = 4
"""More cycles behind than this: the process was held up, and the cycles count as late."""


def precise_loop() -> asyncio.AbstractEventLoop:
    """Make an event loop whose timers are due to the microsecond; the usual one rounds up to milliseconds."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


class Clock:
    """Calls `tick(due_ns, late)` once per cycle, every one of them, in order, none ever skipped."""

    def __init__(self, cycle_s: float, tick: Callable[[int, bool], None]) -> None:
        self._cycle_ns = cycle_s * 1e9
        self._tick = tick
        self._timer: asyncio.TimerHandle | None = None
        self.start_ns = 0
        """Host time of the controller's time 0."""
        self.count = 0

    def due_ns(self, cycle: int) -> int:
        return self.start_ns + round(cycle * self._cycle_ns)

    def restart(self) -> None:
        """Controller time begins at 0."""
        self.start_ns, self.count = time.monotonic_ns(), 0
        self._arm()

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _arm(self) -> None:
        self.stop()
        at_s = self.due_ns(self.count + 1) / 1e9
        self._timer = asyncio.get_running_loop().call_at(at_s, self._wake)

    def _wake(self) -> None:
        try:
            self._catch_up(time.monotonic_ns())
        finally:
            self._arm()

    def _catch_up(self, now_ns: int) -> None:
        behind = int((now_ns - self.start_ns) / self._cycle_ns) - self.count
        late = behind > LATE_CYCLES
        for left in reversed(range(min(behind, CHUNK))):
            self.count += 1
            due_ns = self.due_ns(self.count)
            self._tick(due_ns, late and left > 0)  # to program and watchdog they are one cycle


class Machine:
    def __init__(self, host: str, settings: Settings) -> None:
        self.host = host
        self.settings = settings
        self.robot = SimulatedRobot(settings, Journal())
        self.clock = Clock(self.robot.dt_s, self._tick)
        self.rtde = RtdeServer(host, self.robot)
        dashboard = dashboard_service(host, self.robot)
        self.services = [self.rtde.service, *script_services(host, self.robot), dashboard]
        self._rebooting: asyncio.Task[None] | None = None

    def open(self) -> None:
        """Raises OSError when a port of the address is taken."""
        for service in self.services:
            service.open()
        self.clock.restart()
        self._begin()

    def _begin(self) -> None:
        """The arm's place at controller time 0."""
        self.robot.history.add(self.clock.start_ns, self.robot.arm.actual, self.robot.arm.miss)

    def _tick(self, due_ns: int, late: bool) -> None:
        self.robot.tick(due_ns, late)
        self.rtde.send_states()

    def chosen(self, ports: list[str] | None) -> list[Service]:
        """Services whose name begins with one of these words; all for None. ValueError for none."""
        if ports is None:
            return self.services
        services = [s for s in self.services if any(s.name.startswith(p) for p in ports)]
        if not services:
            raise ValueError(f"ports are any of {[s.name for s in self.services]}, not {ports}")
        return services

    def reboot(self, down_s: float, running: bool) -> None:
        """All links reset, all ports closed for a while, then a fresh controller: time 0, empty registers.

        The installation (TCP, payload) survives, faults of links do not; the arm stays where it is, powered
        off unless `running`.
        """
        self._rebooting = asyncio.get_running_loop().create_task(self._reboot(down_s, running))

    async def _reboot(self, down_s: float, running: bool) -> None:
        robot = self.robot
        robot.power_off()
        for service in self.services:
            service.close()
        await asyncio.sleep(down_s)
        robot.reset(running)
        self.clock.restart()
        self._begin()
        self.rtde.stalled = self.rtde.frozen = False
        for service in self.services:
            service.open()

    def close(self) -> None:
        for service in self.services:
            service.close("fin")
        self.clock.stop()
