"""Ports 30002 and 30003: programs come in as text; nothing is sent back."""

from __future__ import annotations

from station.simulation.controller.network import Connection, Service
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.uploads import UploadReader

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
