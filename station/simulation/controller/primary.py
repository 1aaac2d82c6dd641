"""Ports 30001–30003: programs as text come in; of the first two, state and messages go out.

Every message is an int32 size (of all of it) and more, big-endian. Source: Universal Robots, "Remote Control
via TCP/IP" and its tables of the client interfaces (robot state and messages).
"""

from __future__ import annotations

import asyncio
import struct
import zlib

from station.devices.rtde import RuntimeState
from station.simulation.controller.kinematics import JOINT_LIMIT_RAD
from station.simulation.controller.network import Connection, Service
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.uploads import UploadReader

PRIMARY_PORT, SECONDARY_PORT, REAL_TIME_PORT = 30001, 30002, 30003
STATE_PERIOD_S = 0.1
_ROBOT_STATE, _ROBOT_MESSAGE = 16, 20
_TEXT, _VERSION, _KEY, _RUNTIME_EXCEPTION = 0, 3, 7, 10
_SOURCE_CONTROLLER = 7
_KINEMATICS, _CONFIGURATION = 5, 6
_ROBOT_TYPES = {"UR5": 1, "UR10": 2, "UR3": 3, "UR16": 4}
_JOINTS = (
    "actual_q", "target_q", "actual_qd", "actual_current", "actual_joint_voltage", "joint_temperatures",
    "joint_mode",
)  # fmt: skip
"""Of each joint in a robot state message."""


def _frame(kind: int, payload: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(payload), kind) + payload


# -- messages -------------------------------------------------------------------------------------------


def _message(robot: SimulatedRobot, kind: int, payload: bytes) -> bytes:
    head = struct.pack(">QbB", int(robot.time_s * 1e6), _SOURCE_CONTROLLER, kind)
    return _frame(_ROBOT_MESSAGE, head + payload)


def version_message(robot: SimulatedRobot) -> bytes:
    major, minor, bugfix, build = robot.settings.version
    name = b"URControl"
    numbers = struct.pack(">BBii", major, minor, bugfix, build)
    return _message(robot, _VERSION, bytes([len(name)]) + name + numbers + b"31-03-2020, 00:00:00")


def messages(robot: SimulatedRobot, kind: str, details: dict[str, object]) -> bytes:
    """Encode a message of a program: text, key (title, text) or exception (line, text)."""
    text = str(details.get("text", "")).encode()
    title = str(details.get("title", "")).encode()[:255]
    titled = bytes([len(title)]) + title + text
    if kind == "text":
        return _message(robot, _TEXT, text)
    if kind == "key":
        return _message(robot, _KEY, struct.pack(">ii", 0, 0) + titled)
    line = details.get("line")
    where = struct.pack(">ii", line if isinstance(line, int) else 1, 1)
    return _message(robot, _RUNTIME_EXCEPTION, where + text)


# -- state ----------------------------------------------------------------------------------------------


def state(robot: SimulatedRobot, first: bool) -> bytes:
    """A robot state message. The first one of a connection carries calibration and configuration too."""
    parts = _sub_packages(robot)
    if first:
        parts |= {_KINEMATICS: _kinematics(robot), _CONFIGURATION: _configuration(robot)}
    return _frame(_ROBOT_STATE, b"".join(_frame(kind, parts[kind]) for kind in sorted(parts)))


def _sub_packages(robot: SimulatedRobot) -> dict[int, bytes]:
    out = robot.outputs
    get, vector = out.get, out.vector
    bits = int(get("safety_status_bits"))
    powered = int(get("robot_status_bits")) & 1
    running, paused = robot.runtime_state == RuntimeState.PLAYING, robot.runtime_state == RuntimeState.PAUSED
    flags = (True, True, powered, bits >> 7 & 1, bits >> 2 & 1, running, paused)
    modes = (robot.robot_mode & 0xFF, 2 if robot.freedrive else 0)
    joints = zip(*map(vector, _JOINTS), strict=True)
    types = int(get("analog_io_types"))
    inputs = [get(f"standard_analog_input{i}") for i in (0, 1)]
    outputs = [get(f"standard_analog_output{i}") for i in (0, 1)]
    return {
        0: struct.pack(
            ">Q7?BBddd", int(robot.time_s * 1e6), *map(bool, flags), *modes,
            robot.slider, get("speed_scaling") * robot.slider, 1.0,
        ) + bytes(robot.settings.version >= (3, 5)),
        1: b"".join(
            struct.pack(">dddffffB", *numbers, celsius, celsius, int(mode))
            for *numbers, celsius, mode in joints
        ),
        2: struct.pack(
            ">bbddfBffB", 0, 0, get("tool_analog_input0"), get("tool_analog_input1"), 48.0,
            int(get("tool_output_voltage")), get("tool_output_current"), get("tool_temperature"),
            int(get("tool_mode")),
        ),
        3: struct.pack(
            ">iibbddbbddffffBBbIBBB",
            int(get("actual_digital_input_bits")), int(get("actual_digital_output_bits")),
            types & 1, types >> 1 & 1, *inputs, types >> 2 & 1, types >> 3 & 1, *outputs,
            40.0, get("actual_robot_voltage"), get("actual_robot_current"), get("io_current"),
            int(robot.safety_mode), 0, 0, 0, 0, 0, 0,
        ),
        4: struct.pack(">12d", *vector("actual_TCP_pose"), *robot.tcp),
        7: struct.pack(">7d", *vector("actual_TCP_force"), 0.0),
        8: struct.pack(">B??B", robot.freedrive, True, False, 0),
    }  # fmt: skip


def _kinematics(robot: SimulatedRobot) -> bytes:
    """The factory calibration that is stated, never the true arm's lengths."""
    table = robot.stated_table
    numbers = (*table.theta_rad, *table.a_m, *table.d_m, *table.alpha_rad)
    joints = zip(table.theta_rad, table.a_m, table.d_m, table.alpha_rad, strict=True)
    checksums = (zlib.crc32(struct.pack(">4d", *joint)) for joint in joints)
    return struct.pack(">6I24dI", *checksums, *numbers, 1)


def _configuration(robot: SimulatedRobot) -> bytes:
    published = robot.stated_table.published or robot.stated_table
    limits = (-JOINT_LIMIT_RAD, JOINT_LIMIT_RAD) * 6
    motion = (3.14159, 40.0) * 6
    defaults = (1.05, 1.4, 0.25, 1.2, 0.2)
    tables = (*published.a_m, *published.d_m, *published.alpha_rad, *published.theta_rad)
    kind = _ROBOT_TYPES[robot.settings.model.rstrip("e")]
    e_series = robot.settings.is_e_series
    return struct.pack(
        ">53d4i", *limits, *motion, *defaults, *tables, 4, 4 if e_series else 2, kind, e_series
    )


# -- ports ----------------------------------------------------------------------------------------------


class ScriptConnection(Connection):
    """Takes programs; states version and state, but not on the real-time port."""

    def __init__(self, robot: SimulatedRobot, port: int) -> None:
        self._robot, self._port = robot, port
        self._uploads = UploadReader()

    def received(self, data: bytes) -> None:
        try:
            for upload in self._uploads.feed(data):
                self._robot.upload(upload)
        except ValueError as error:
            self._robot.journal.note("upload", "refused", error=str(error))
            self.transport.close()

    def opened(self) -> None:
        if self._port != REAL_TIME_PORT:
            self.say(version_message(self._robot))
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

    def tell(kind: str, **details: object) -> None:
        for connection in services[0].connections:
            assert isinstance(connection, ScriptConnection)
            connection.say(messages(robot, kind, details))

    robot.tell = tell
    return services
