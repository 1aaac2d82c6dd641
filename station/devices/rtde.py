"""RTDE, the real-time data exchange of Universal Robots controllers (version 2): packets and handshake.

One packet = uint16 size of the whole packet, uint8 type, payload; everything big-endian. Shared by the
state reader (client) and the simulated controller (server). Source: Universal Robots, "Real-Time Data
Exchange (RTDE) Guide". Pure standard library.
"""

from __future__ import annotations

import socket
import struct
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

from station.cell.errors import RobotError

HANDSHAKE_S = 2.0
PORT = 30004
PROTOCOL_VERSION = 2
HEADER = struct.Struct(">HB")


class RtdeError(RobotError):
    """The bytes on the connection are not RTDE, or a variable was refused."""

    code = "rtde"


class PacketType(IntEnum):
    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    TEXT_MESSAGE = ord("M")
    DATA = ord("U")
    OUTPUT_SETUP = ord("O")
    INPUT_SETUP = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class RobotMode(IntEnum):
    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7


class SafetyMode(IntEnum):
    """From 10 on as in Universal Robots' client library: the RTDE guide ends at 9."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9
    VALIDATE_JOINT_ID = 10
    UNDEFINED_SAFETY_MODE = 11
    AUTOMATIC_MODE_SAFEGUARD_STOP = 12
    SYSTEM_THREE_POSITION_ENABLING_STOP = 13
    TP_THREE_POSITION_ENABLING_STOP = 14
    IMMI_EMERGENCY_STOP = 15
    IMMI_SAFEGUARD_STOP = 16
    PROFISAFE_WAITING_FOR_PARAMETERS = 17
    PROFISAFE_AUTOMATIC_MODE_SAFEGUARD_STOP = 18
    PROFISAFE_SAFEGUARD_STOP = 19
    PROFISAFE_EMERGENCY_STOP = 20
    SAFETY_API_SAFEGUARD_STOP = 21


class SafetyStatus(IntFlag):
    """The bits of `safety_status_bits`."""

    NORMAL = 1 << 0
    REDUCED = 1 << 1
    PROTECTIVE_STOPPED = 1 << 2
    RECOVERY = 1 << 3
    SAFEGUARD_STOPPED = 1 << 4
    SYSTEM_EMERGENCY_STOPPED = 1 << 5
    ROBOT_EMERGENCY_STOPPED = 1 << 6
    EMERGENCY_STOPPED = 1 << 7
    VIOLATION = 1 << 8
    FAULT = 1 << 9
    STOPPED_DUE_TO_SAFETY = 1 << 10


class RuntimeState(IntEnum):
    """State of the program; it runs only when PLAYING."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class RobotStatusBits(IntFlag):
    """The bits of `robot_status_bits`."""

    POWER_ON = 1 << 0
    PROGRAM_RUNNING = 1 << 1
    TEACH_BUTTON = 1 << 2
    POWER_BUTTON = 1 << 3


DATA_TYPES = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "ddd",
    "VECTOR6D": "dddddd",
    "VECTOR6INT32": "iiiiii",
    "VECTOR6UINT32": "IIIIII",
}
"""Name → `struct`'s code of each element."""
NOT_FOUND = "NOT_FOUND"
IN_USE = "IN_USE"


def packet(kind: PacketType, payload: bytes = b"") -> bytes:
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


class PacketReader:
    """Splits a byte stream into packets; buffers at most one incomplete packet (64 kB)."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Add bytes; return the packets (type, payload) now complete. RtdeError for an impossible size."""
        data = self._rest + data if self._rest else data
        packets = []
        start, end = 0, len(data)
        while end - start >= HEADER.size:
            size, kind = HEADER.unpack_from(data, start)
            if size < HEADER.size:
                raise RtdeError(reason=f"a packet claims {size} bytes, so the other side is not RTDE")
            if end - start < size:
                break
            packets.append((kind, data[start + HEADER.size : start + size]))
            start += size
        self._rest = data[start:]
        return packets


@dataclass(frozen=True)
class Recipe:
    """List of variables agreed with the controller, and the layout of their values in a data packet."""

    id: int
    names: tuple[str, ...]
    types: tuple[str, ...]
    packer: struct.Struct = field(init=False, repr=False, compare=False)
    """A whole data packet: size, type, recipe id, then every element in order."""

    def __post_init__(self) -> None:
        refused = [n for n, t in zip(self.names, self.types, strict=True) if t not in DATA_TYPES]
        if refused:
            raise RtdeError("rtde-variables", names=", ".join(refused))
        codes = "".join(DATA_TYPES[t] for t in self.types)
        object.__setattr__(self, "packer", struct.Struct(">HBB" + codes))

    def pack(self, elements: Sequence[bool | int | float]) -> bytes:
        """Pack elements (vectors flattened) to a complete data packet."""
        return self.packer.pack(self.packer.size, PacketType.DATA, self.id, *elements)

    def unpack_elements(self, payload: bytes) -> tuple[float, ...]:
        """Unpack a data packet's payload (recipe id first) to elements. RtdeError for a wrong length."""
        if len(payload) != self.packer.size - HEADER.size:
            expected = self.packer.size - HEADER.size
            raise RtdeError("rtde-size", recipe=self.id, size_bytes=len(payload), expected_bytes=expected)
        return self.packer.unpack(HEADER.pack(self.packer.size, PacketType.DATA) + payload)[3:]


def join_names(names: Iterable[str]) -> bytes:
    return ",".join(names).encode("ascii")


def split_names(payload: bytes) -> tuple[str, ...]:
    """Split comma-separated names; a trailing comma is allowed. RtdeError when they are not ASCII."""
    try:
        text = payload.decode("ascii")
    except UnicodeDecodeError:
        raise RtdeError(reason="a list of variable names is not ASCII") from None
    return tuple(name for name in text.split(",") if name)


class RtdeLink:
    """RTDE client on a connected socket. Calls raise RtdeError, OSError, and TimeoutError without answer."""

    def __init__(self, link: socket.socket) -> None:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.settimeout(HANDSHAKE_S)
        self._link = link
        self.packets = PacketReader()
        self.pending: deque[tuple[int, bytes]] = deque()
        """Packets received with an answer and not yet handled: after `start`, the first data packets."""
        accepted = self._ask(PacketType.PROTOCOL_VERSION, struct.pack(">H", PROTOCOL_VERSION))
        if accepted != b"\x01":
            raise RtdeError(reason=f"the controller does not speak RTDE version {PROTOCOL_VERSION}")

    def version(self) -> tuple[int, int, int, int]:
        answer = self._ask(PacketType.CONTROLLER_VERSION)
        if len(answer) != 16:
            raise RtdeError(reason=f"the controller's version has {len(answer)} bytes, expected 16")
        major, minor, bugfix, build = struct.unpack(">4I", answer)
        return major, minor, bugfix, build

    def outputs(self, rate_hz: float, names: Sequence[str]) -> Recipe:
        """Request these output variables at `rate_hz`; return their recipe."""
        answer = self._ask(PacketType.OUTPUT_SETUP, struct.pack(">d", rate_hz) + join_names(names))
        return _recipe(answer, names)

    def inputs(self, names: Sequence[str]) -> Recipe:
        """Claim these input variables; RtdeError `registers-in-use` where another connection has one."""
        answer = self._ask(PacketType.INPUT_SETUP, join_names(names))
        if IN_USE in split_names(answer[1:]):
            raise RtdeError("registers-in-use")
        return _recipe(answer, names)

    def start(self) -> None:
        if self._ask(PacketType.START) != b"\x01":
            raise RtdeError(reason="the controller refused to send its state")

    def _ask(self, kind: PacketType, payload: bytes = b"") -> bytes:
        """Send a request; return the payload of its reply. Messages before it are skipped."""
        self._link.sendall(packet(kind, payload))
        give_up_s = time.monotonic() + HANDSHAKE_S
        while time.monotonic() < give_up_s:
            while self.pending:
                got, answer = self.pending.popleft()
                if got == kind:
                    return answer
            data = self._link.recv(65536)
            if not data:
                raise RtdeError(reason="the controller closed the RTDE connection during the handshake")
            self.pending.extend(self.packets.feed(data))
        raise TimeoutError


def _recipe(answer: bytes, names: Sequence[str]) -> Recipe:
    types = split_names(answer[1:])
    if len(types) != len(names):
        raise RtdeError(reason=f"the controller answered {len(types)} types for {len(names)} variables")
    return Recipe(answer[0], tuple(names), types)
