"""Ports 30001–30003: programs as text come in; of the first two, the robot's state goes out.

A state message holds the TCP; the first one of a connection the factory calibration, too. The first port also
tells which program started. Every message is an int32 size (of all of it) and more, big-endian.
Source: Universal Robots, "Remote Control via TCP/IP" and its tables of the client interfaces.
"""

from __future__ import annotations

import asyncio
import struct
import zlib

from station.simulation.controller.network import Connection, Service
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.uploads import UploadReader

PRIMARY_PORT, SECONDARY_PORT, REAL_TIME_PORT = 30001, 30002, 30003
STATE_PERIOD_S = 0.1
_ROBOT_STATE, _ROBOT_MESSAGE, _KEY = 16, 20, 7
_SOURCE_CONTROLLER = 7
_CARTESIAN, _KINEMATICS = 4, 5


def _frame(kind: int, payload: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(payload), kind) + payload


def program_started(robot: SimulatedRobot, name: str) -> bytes:
    title = b"PROGRAM_XXX_STARTED"
    head = struct.pack(">QbBii", int(robot.time_s * 1e6), _SOURCE_CONTROLLER, _KEY, 0, 0)
    return _frame(_ROBOT_MESSAGE, head + bytes([len(title)]) + title + name.encode())


def state(robot: SimulatedRobot, first: bool) -> bytes:
    """A robot state message. The first one of a connection carries the calibration."""
    tool = struct.pack(">12d", *robot.outputs.vector("actual_TCP_pose"), *robot.tcp)
    parts = _frame(_CARTESIAN, tool) + (_frame(_KINEMATICS, _kinematics(robot)) if first else b"")
    return _frame(_ROBOT_STATE, parts)


def _kinematics(robot: SimulatedRobot) -> bytes:
    """The factory calibration, never the true arm's lengths."""
    table = robot.table
    numbers = (*table.theta_rad, *table.a_m, *table.d_m, *table.alpha_rad)
    joints = zip(table.theta_rad, table.a_m, table.d_m, table.alpha_rad, strict=True)
    checksums = (zlib.crc32(struct.pack(">4d", *joint)) for joint in joints)
    return struct.pack(">6I24dI", *checksums, *numbers, 1)


class ScriptConnection(Connection):
    """Takes programs; sends the state, but not on the real-time port."""

    def __init__(self, robot: SimulatedRobot, port: int) -> None:
        self._robot, self._port = robot, port
        self._uploads = UploadReader()

    def received(self, data: bytes) -> None:
        for upload in self._uploads.feed(data):
            self._robot.upload(upload)

    def opened(self) -> None:
        if self._port != REAL_TIME_PORT:
            self._send(first=True)

    def say(self, data: bytes) -> None:
        """Skipped for a client that does not read."""
        closed = self.transport.is_closing() or self.service.silent
        if not closed and not self.transport.get_write_buffer_size():
            self.transport.write(data)

    def _send(self, first: bool = False) -> None:
        if not self.transport.is_closing():
            self.say(state(self._robot, first))
            asyncio.get_running_loop().call_later(STATE_PERIOD_S, self._send)


def script_services(host: str, robot: SimulatedRobot) -> list[Service]:
    """The three ports. What programs say goes to whoever listens on the first."""

    def service(port: int) -> Service:
        return Service(f"script{port}", host, port, lambda: ScriptConnection(robot, port))

    services = [service(port) for port in (PRIMARY_PORT, SECONDARY_PORT, REAL_TIME_PORT)]

    def tell(program: str) -> None:
        for connection in services[0].connections:
            assert isinstance(connection, ScriptConnection)
            connection.say(program_started(robot, program))

    robot.tell = tell
    return services
