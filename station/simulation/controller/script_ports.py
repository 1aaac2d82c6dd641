"""Port 30001 beside taking programs: ten times a second the tool's pose and offset, once the kinematics."""

from __future__ import annotations

import asyncio

from station.devices.ur_primary import DhParameters, pack_state
from station.simulation.controller.network import Connection, Service
from station.simulation.controller.programs import UploadReader
from station.simulation.controller.robot import SimulatedRobot

PORT = 30001
PERIOD_S = 0.1
PORTS = (30002, 30003)


class ScriptConnection(Connection):
    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot = robot
        self._uploads = UploadReader()

    def received(self, data: bytes) -> None:
        try:
            for upload in self._uploads.feed(data):
                self._robot.upload(upload)
        except ValueError as error:
            self._robot.journal.note("upload", "refused", error=str(error))
            self.transport.close()


def script_services(host: str, robot: SimulatedRobot) -> list[Service]:
    return [Service(f"script{port}", host, port, lambda: ScriptConnection(robot)) for port in PORTS]


class PrimaryConnection(ScriptConnection):
    """States the controller's beliefs: the nominal table, never the true arm's lengths."""

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
