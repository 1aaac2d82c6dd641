"""Port 30004: handshake, data to clients every cycle, registers from clients."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

from station.devices.rtde import (
    IN_USE,
    NOT_FOUND,
    PORT,
    PROTOCOL_VERSION,
    PacketReader,
    PacketType,
    Recipe,
    RtdeError,
    join_names,
    packet,
    split_names,
)
from station.simulation.controller.network import Connection, Service
from station.simulation.controller.robot import SimulatedRobot

ADMIN = "admin"


class RtdeServer:
    def __init__(self, host: str, robot: SimulatedRobot) -> None:
        self.robot = robot
        self.service = Service("rtde", host, PORT, lambda: RtdeConnection(self))
        self.claims: dict[str, object] = {}
        """Input name → the connection (or the admin) that owns it."""
        self.stalled = False
        """Fault: connections stay open and are answered, but no states are sent."""
        self.frozen = False
        """Fault: the last state is sent again every cycle, its clock standing still."""
        self.spoiled: tuple[str, ...] = ()
        """Fault: names of the outputs that are sent as NaN."""

    def send_states(self) -> None:
        """Called once per cycle."""
        for connection in self.service.connections:
            assert isinstance(connection, RtdeConnection)
            connection.send_state()

    def claim(self, name: str, owner: object) -> bool:
        return self.claims.setdefault(name, owner) is owner

    def release(self, owner: object) -> None:
        self.claims = {name: o for name, o in self.claims.items() if o is not owner}


class RtdeConnection(Connection):
    def __init__(self, server: RtdeServer) -> None:
        self._server = server
        self._robot = server.robot
        self._packets = PacketReader()
        self._inputs: list[Recipe] = []
        self._output: Recipe | None = None
        self._elements: Any = None
        """Takes the elements of the states that this client asked for from all outputs."""
        self._every = 1
        """Controller cycles from one state sent to the next."""
        self._playing = False
        self._last = b""
        self._handlers = {
            PacketType.PROTOCOL_VERSION: self._protocol_version,
            PacketType.CONTROLLER_VERSION: self._controller_version,
            PacketType.OUTPUT_SETUP: self._output_setup,
            PacketType.INPUT_SETUP: self._input_setup,
            PacketType.START: self._start,
            PacketType.PAUSE: self._pause,
        }

    def received(self, data: bytes) -> None:
        try:
            for kind, payload in self._packets.feed(data):
                if kind == PacketType.DATA:
                    self._data(payload)
                elif kind in self._handlers:
                    kind = PacketType(kind)
                    self.transport.write(packet(kind, self._handlers[kind](payload)))
                else:
                    raise RtdeError(reason=f"packet type {kind}")
        except (RtdeError, struct.error) as error:
            self._robot.journal.note("controller", "bad RTDE packet", error=str(error))
            self.transport.close()

    def closed(self) -> None:
        self._server.release(self)

    def _protocol_version(self, payload: bytes) -> bytes:
        (version,) = struct.unpack(">H", payload)
        return bytes([version == PROTOCOL_VERSION])

    def _controller_version(self, payload: bytes) -> bytes:
        return struct.pack(">4I", *self._robot.settings.version)

    def _output_setup(self, payload: bytes) -> bytes:
        (frequency_hz,) = struct.unpack_from(">d", payload)
        names = split_names(payload[8:])
        types = [self._robot.outputs.types.get(name, NOT_FOUND) for name in names]
        if not names or NOT_FOUND in types:
            return b"\x00" + join_names(types)
        base_hz = self._robot.settings.rate_hz
        self._every = round(base_hz / min(frequency_hz, base_hz)) if frequency_hz >= 1 else base_hz
        self._output = Recipe(1, names, tuple(types))
        # One index more than asked for, cut off when read: of a single one itemgetter gives no tuple.
        self._elements = itemgetter(*self._robot.outputs.indices(names), 0)
        return b"\x01" + join_names(types)

    def _input_setup(self, payload: bytes) -> bytes:
        names = split_names(payload)
        types = [self._input_type(name) for name in names]
        if NOT_FOUND in types or IN_USE in types:
            return b"\x00" + join_names(types)
        self._inputs.append(Recipe(len(self._inputs) + 1, names, tuple(types)))
        return bytes([len(self._inputs)]) + join_names(types)

    def _input_type(self, name: str) -> str:
        if name not in self._robot.inputs.types:
            return NOT_FOUND
        return self._robot.inputs.types[name] if self._server.claim(name, self) else IN_USE

    def _start(self, payload: bytes) -> bytes:
        self._playing = self._output is not None
        return bytes([self._playing])

    def _pause(self, payload: bytes) -> bytes:
        self._playing = False
        return b"\x01"

    def _data(self, payload: bytes) -> None:
        number = payload[0] if payload else 0
        if not 1 <= number <= len(self._inputs):
            raise RtdeError(reason=f"data for input recipe {number}, which was never set up")
        recipe = self._inputs[number - 1]
        self._robot.receive_inputs(recipe.names, recipe.unpack_elements(payload))

    def _sent(self) -> Sequence[Any]:
        """Elements of all outputs as they are sent: the robot's, but for those that are spoiled."""
        elements = self._robot.outputs.elements
        spoiled = self._server.spoiled
        if not spoiled:
            return elements
        changed = list(elements)
        for index in self._robot.outputs.indices(spoiled):
            changed[index] = math.nan
        return changed

    def send_state(self) -> None:
        server = self._server
        if not self._playing or server.stalled or self.service.silent or self._robot.ticks % self._every:
            return
        if not (server.frozen and self._last):
            assert self._output is not None
            self._last = self._output.pack(self._elements(self._sent())[:-1])
        if self.transport.is_closing() or self.transport.get_write_buffer_size():
            return  # for a client that does not read nothing is queued
        self.transport.write(self._last)
