"""A client's side of RTDE until its stream starts: one question after the other, each with a deadline."""

from __future__ import annotations

import socket
import struct
import time
from collections import deque
from collections.abc import Sequence

from station.devices.rtde import (
    IN_USE,
    NOT_FOUND,
    PROTOCOL_VERSION,
    PacketReader,
    PacketType,
    Recipe,
    RtdeError,
    join_names,
    packet,
    split_names,
)

HANDSHAKE_S = 2.0


class RtdeLink:
    """On a connected socket. Raises RtdeError, OSError, and TimeoutError for an answer that does not come."""

    def __init__(self, link: socket.socket) -> None:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.settimeout(HANDSHAKE_S)
        self._link = link
        self.packets = PacketReader()
        self.pending: deque[tuple[int, bytes]] = deque()
        """Data that arrived and was not yet read: after `start`, the first data."""
        accepted = self._ask(PacketType.PROTOCOL_VERSION, struct.pack(">H", PROTOCOL_VERSION))
        if accepted != b"\x01":
            raise RtdeError(f"the controller does not speak RTDE version {PROTOCOL_VERSION}")

    def version(self) -> tuple[int, int, int, int]:
        answer = self._ask(PacketType.CONTROLLER_VERSION)
        if len(answer) != 16:
            raise RtdeError(f"the controller's version has {len(answer)} bytes, expected 16")
        major, minor, bugfix, build = struct.unpack(">4I", answer)
        return major, minor, bugfix, build

    def outputs(self, rate_hz: float, names: Sequence[str]) -> Recipe:
        """Asks for these variables, so many times a second."""
        answer = self._ask(PacketType.OUTPUT_SETUP, struct.pack(">d", rate_hz) + join_names(names))
        return _recipe(answer, names)

    def inputs(self, names: Sequence[str]) -> Recipe:
        """Claims these variables for this connection. RtdeError `registers-in-use` where another owns one."""
        answer = self._ask(PacketType.INPUT_SETUP, join_names(names))
        if IN_USE in split_names(answer[1:]):
            raise RtdeError(
                "another client owns the RTDE input registers",
                code="registers-in-use",
                remedy="Close that program, or the field bus on the pendant, then try again.",
            )
        return _recipe(answer, names)

    def start(self) -> None:
        if self._ask(PacketType.START) != b"\x01":
            raise RtdeError("the controller refused to send its state")

    def pause(self) -> None:
        """The state is sent no more."""
        self._ask(PacketType.PAUSE)

    def _ask(self, kind: PacketType, payload: bytes = b"") -> bytes:
        """The reply's payload; what else arrives before it (messages) is skipped."""
        self._link.sendall(packet(kind, payload))
        give_up_s = time.monotonic() + HANDSHAKE_S
        while time.monotonic() < give_up_s:
            while self.pending:
                got, answer = self.pending.popleft()
                if got == kind:
                    return answer
            data = self._link.recv(65536)
            if not data:
                raise RtdeError("the controller closed the RTDE connection during the handshake")
            self.pending.extend(self.packets.feed(data))
        raise TimeoutError


def _recipe(answer: bytes, names: Sequence[str]) -> Recipe:
    types = split_names(answer[1:])
    if len(types) != len(names):
        raise RtdeError(f"asked for {len(names)} variables, the controller answered {len(types)} types")
    refused = [n for n, t in zip(names, types, strict=True) if t == NOT_FOUND]
    if refused:
        raise RtdeError(f"the controller has no {', '.join(refused)}; update its software")
    return Recipe(answer[0], tuple(names), types)
