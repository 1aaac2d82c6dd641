"""Port 30001 beside taking programs: ten times a second the tool's pose and offset, once the kinematics."""

from __future__ import annotations

import asyncio

from station.devices.ur_primary import DhParameters, pack_state
from station.simulation.controller.network import Service
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.script_port import ScriptConnection

PORT = 30001
PERIOD_S = 0.1


class PrimaryConnection(ScriptConnection):
    """What it states are the controller's beliefs: the nominal table, never the true arm's lengths."""

    def opened(self) -> None:
        table = self._robot.table
        self._send(DhParameters(table.theta_rad, table.a_m, table.d_m, table.alpha_rad))  # type: ignore[arg-type]

    def _send(self, dh: DhParameters | None = None) -> None:
        if self.transport.is_closing():
            return
        if not self.service.silent and not self.transport.get_write_buffer_size():
            pose = self._robot.outputs.vector("actual_TCP_pose")
            self.transport.write(pack_state(pose, self._robot.tcp, dh))
        asyncio.get_running_loop().call_later(PERIOD_S, self._send)


def primary_service(host: str, robot: SimulatedRobot) -> Service:
    return Service(f"script{PORT}", host, PORT, lambda: PrimaryConnection(robot))
