"""The whole controller on one address: robot, clock and every port."""

from __future__ import annotations

import asyncio

from station.simulation.controller.clock import Clock
from station.simulation.controller.dashboard import dashboard_service
from station.simulation.controller.journal import Journal
from station.simulation.controller.network import Cut, Service
from station.simulation.controller.primary_port import primary_service
from station.simulation.controller.robot import Settings, SimulatedRobot
from station.simulation.controller.rtde_server import RtdeServer
from station.simulation.controller.script_port import script_services


class Machine:
    def __init__(self, host: str, settings: Settings, drift_ppm: float = 0.0) -> None:
        self.host = host
        self.settings = settings
        self.robot = SimulatedRobot(settings, Journal())
        self.clock = Clock(self.robot.dt_s / (1 + drift_ppm * 1e-6), self._tick)
        self.rtde = RtdeServer(host, self.robot)
        self.dashboard = dashboard_service(host, self.robot)
        scripts = (primary_service(host, self.robot), *script_services(host, self.robot))
        self.services = [self.rtde.service, *scripts, self.dashboard]
        self.lose_packets = 0
        self._rebooting: asyncio.Task[None] | None = None

    def open(self) -> None:
        """Raises OSError when a port of the address is taken."""
        for service in self.services:
            service.open()
        self.clock.start()
        self._begin()

    def _begin(self) -> None:
        """The arm's place at controller time 0."""
        self.robot.history.add(self.clock.start_ns, self.robot.arm.actual, self.robot.arm.miss)

    def _tick(self, due_ns: int, late: bool) -> None:
        self.robot.tick(due_ns, late)
        if self.lose_packets > 0:
            self.lose_packets -= 1
            self.rtde.lose()
        else:
            self.rtde.send_states()

    def chosen(self, ports: list[str] | None) -> list[Service]:
        """Services whose name begins with one of these words; all for None. ValueError for none, and while
        the controller reboots."""
        self._refuse_while_rebooting()
        if ports is None:
            return self.services
        services = [s for s in self.services if any(s.name.startswith(p) for p in ports)]
        if not services:
            raise ValueError(f"ports are any of {[s.name for s in self.services]}, not {ports}")
        return services

    def cut(self, how: Cut, ports: list[str] | None) -> int:
        return sum(service.cut(how) for service in self.chosen(ports))

    def reboot(self, down_s: float, running: bool) -> None:
        """All links reset, all ports closed for a while, then a fresh controller: time 0, empty registers.

        The installation (TCP, payload) survives, faults of links do not; the arm stays where it is, powered
        off unless `running`. ValueError while it reboots already.
        """
        self._refuse_while_rebooting()
        self._rebooting = asyncio.get_running_loop().create_task(self._reboot(down_s, running))

    def _refuse_while_rebooting(self) -> None:
        if self._rebooting is not None and not self._rebooting.done():
            raise ValueError("the controller is rebooting")

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
