"""Controllers as processes, a raw client, robots without sockets."""

from __future__ import annotations

import socket
import struct
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import islice
from typing import Any

import pytest

from station.devices.rtde import (
    DATA_TYPES,
    PORT,
    PacketReader,
    PacketType,
    Recipe,
    RuntimeState,
    join_names,
    packet,
    split_names,
)
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.state import Journal, Settings
from station.simulation.controller.uploads import UploadReader
from station.simulation.launch import AdminClient, SimulatedController, start_controller
from tests.patience import PATIENCE_S


@pytest.fixture
def controller() -> Iterator[Callable[..., SimulatedController]]:
    """Starts controllers: `controller("UR10", time_scale=…)`; all end with the test."""
    with ExitStack() as ends:
        yield lambda model="UR10", **options: ends.enter_context(start_controller(model, **options))


@pytest.fixture
def admin() -> Iterator[Callable[[SimulatedController], AdminClient]]:
    with ExitStack() as ends:
        yield lambda running: ends.enter_context(running.admin())


class RtdeClient:
    """A raw client of port 30004, blocking, with a timeout."""

    def __init__(self, host: str, timeout_s: float = PATIENCE_S) -> None:
        self._socket = socket.create_connection((host, PORT), timeout_s)
        self._reader = PacketReader()
        self._waiting: deque[tuple[int, bytes]] = deque()
        self.output: Recipe | None = None

    def receive(self) -> tuple[int, bytes]:
        """The next packet. TimeoutError when none comes, ConnectionError when the link ends."""
        while not self._waiting:
            data = self._socket.recv(65536)
            if not data:
                raise ConnectionError("closed by the controller")
            self._waiting += self._reader.feed(data)
        return self._waiting.popleft()

    def send(self, data: bytes) -> None:
        self._socket.sendall(data)

    def request(self, kind: PacketType, payload: bytes = b"") -> bytes:
        self.send(packet(kind, payload))
        answer, reply = self.receive()
        assert answer == kind
        return reply

    def start(self, *names: str, frequency_hz: float = 500.0) -> None:
        """Version, output setup, start."""
        assert self.request(PacketType.PROTOCOL_VERSION, b"\x00\x02") == b"\x01"
        reply = self.request(
            PacketType.OUTPUT_SETUP, struct.pack(">d", frequency_hz) + join_names(names) + b","
        )
        self.output = Recipe(reply[0], names, split_names(reply[1:]))
        assert self.request(PacketType.START) == b"\x01"

    def inputs(self, *names: str) -> Recipe:
        reply = self.request(PacketType.INPUT_SETUP, join_names(names) + b",")
        return Recipe(reply[0], names, split_names(reply[1:]))

    def sample(self) -> dict[str, Any]:
        kind, payload = self.receive()
        assert kind == PacketType.DATA and self.output is not None
        recipe, elements = self.output, iter(self.output.unpack_elements(payload))
        types = dict(zip(recipe.names, recipe.types, strict=True))
        counts = {name: len(DATA_TYPES[kind]) for name, kind in types.items()}
        taken = {name: tuple(islice(elements, count)) for name, count in counts.items()}
        return {name: found if counts[name] > 1 else found[0] for name, found in taken.items()}

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def rtde() -> Iterator[Callable[..., RtdeClient]]:
    """Opens raw RTDE connections."""
    with ExitStack() as ends:
        yield lambda running, **how: ends.enter_context(closing(RtdeClient(running.host, **how)))


class SteppedRobot:
    """A robot without sockets: time goes on only by `run`."""

    def __init__(self, **settings: Any) -> None:
        self.robot = SimulatedRobot(Settings(**settings), Journal())
        self._ns = 1_000_000_000

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / self.robot.dt_s)):
            self._ns += round(self.robot.dt_s * 1e9)
            self.robot.tick(self._ns)

    def run_until(self, done: Callable[[], bool], limit_s: float = 30.0) -> float:
        """Simulated seconds that passed."""
        start = self.robot.ticks
        while not done():
            if (self.robot.ticks - start) * self.robot.dt_s > limit_s:
                raise AssertionError(f"not within {limit_s} s")
            self.run(self.robot.dt_s)
        return (self.robot.ticks - start) * self.robot.dt_s

    def run_late(self, cycles: int) -> None:
        """The process was held up: these cycles run at once."""
        for i in range(cycles):
            self.robot.tick(10**12 + i, late=True)

    def start(self, body: str) -> None:
        """A program plays in its first cycles."""
        self.upload(f"def prog():\n{body}\nend\n")
        self.run_until(lambda: self.plays)

    def upload(self, text: str) -> None:
        for upload in UploadReader().feed(text.encode()):
            self.robot.upload(upload)

    def end(self) -> str:
        """Why the program ended, once it has."""
        self.run_until(lambda: self.robot.runtime_state == RuntimeState.STOPPED)
        return str(self.robot.journal.entries(0)[-1]["reason"])

    @property
    def plays(self) -> bool:
        return self.robot.runtime_state == RuntimeState.PLAYING

    @property
    def speed_rad_s(self) -> float:
        return max(map(abs, self.robot.arm.command_speed))

    def output(self, name: str) -> float:
        return self.robot.outputs.get(name)


@pytest.fixture
def stepped() -> Callable[..., SteppedRobot]:
    return SteppedRobot


@pytest.fixture
def started() -> Callable[..., SteppedRobot]:
    """`started(body, **settings)`: a robot on which a program with this body plays."""

    def start(body: str, **settings: Any) -> SteppedRobot:
        made = SteppedRobot(**settings)
        made.start(body)
        return made

    return start
