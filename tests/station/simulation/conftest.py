"""Controllers as processes, robots without sockets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from station.devices.rtde import RuntimeState
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.state import Journal, Settings
from station.simulation.controller.uploads import UploadReader
from station.simulation.launch import SimulatedController, start_controller


@pytest.fixture
def controller() -> Iterator[Callable[..., SimulatedController]]:
    """Starts controllers: `controller("UR10", time_scale=…)`; all end with the test."""
    with ExitStack() as ends:
        yield lambda model="UR10", **options: ends.enter_context(start_controller(model, **options))


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
