"""An arm in motion, faults thrown at it, and a stopwatch: when did it stop, when did the station notice."""

from __future__ import annotations

import asyncio
import json
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from station.cell.config import ControlPath, RobotConfig
from station.cell.errors import RobotError
from station.devices.news import Delay
from station.devices.ur import UrRobot
from station.simulation.camera import RenderedCamera
from station.simulation.cells import make_cell
from station.simulation.launch import AdminClient, SimulatedController
from station.simulation.truth import write_truth
from tests.conftest import AT_REST_RAD_S, asked, check_allow_list, rests_short_of_its_goal
from tests.patience import PATIENCE_S, until

FAR_RAD = 1.5
BEAT_S = 0.03
TRIES = 4


@dataclass
class Outcome:
    """Effect of a fault in mid-move. Times since the fault; on a busy computer they say nothing."""

    error: RobotError
    noticed_s: float
    stopped_s: float


@dataclass
class Cell:
    """A controller and a driver in front of it, with the heartbeat of a session loop."""

    controller: SimulatedController
    admin: AdminClient
    robot: UrRobot
    beating: bool = True
    _tasks: list[asyncio.Task[Any]] = field(default_factory=list)

    def start_heart(self) -> None:
        self._tasks.append(asyncio.create_task(self._heart()))

    async def _heart(self) -> None:
        while True:
            if self.beating:
                self.robot.heartbeat()
            await asyncio.sleep(BEAT_S)

    async def end(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def speed_rad_s(self) -> float:
        """Speed of the fastest joint by the controller's own account, which outlives every cut link."""
        return max(map(abs, self.admin.ask("state")["joint_speeds_rad_s"]))

    def joints_rad(self) -> list[float]:
        joints: list[float] = self.admin.ask("state")["joints_rad"]
        return joints

    def asked(self, what: str) -> int:
        """See `asked`: a key of the log's counts, or upload, move, stop."""
        return asked(self.admin, what)

    def far_goal(self) -> list[float]:
        goal = self.joints_rad()
        goal[0] += FAR_RAD
        return goal

    def far_move(self) -> asyncio.Task[None]:
        """A move of several seconds, under way."""
        return asyncio.create_task(self.robot.move(self.far_goal(), 0.5, 1.0))

    async def cruising(self) -> asyncio.Task[None]:
        """The task of a move that has reached its full speed; begun anew where this computer was too late."""
        for left in reversed(range(TRIES)):
            move = self.far_move()
            await until(lambda move=move: move.done() or self.speed_rad_s() > 0.4)
            if not move.done():
                return move
            try:
                await move
            except RobotError:
                if not left:
                    raise
            await self.robot.start_control()
        raise AssertionError("the arm arrived, again and again, before it was at full speed")

    async def told(self) -> None:
        """What was done before has reached the driver."""
        done_s = self.admin.ask("state")["timestamp_s"]
        await until(lambda: (self.robot.newest().state.stamps.controller_s or 0.0) > done_s)

    async def stops(self) -> None:
        """Before it has arrived."""
        await until(lambda: self.speed_rad_s() < AT_REST_RAD_S)
        rests_short_of_its_goal(self.admin)

    async def strike(self, fault: Callable[[], object]) -> Outcome:
        """The fault in mid-move. The move ends with a RobotError, the arm before its goal."""
        move = await self.cruising()
        begun = time.monotonic()
        noticed: list[float] = []
        move.add_done_callback(lambda _: noticed.append(time.monotonic() - begun))
        fault()
        await self.stops()
        stopped = time.monotonic() - begun
        with suppress(RobotError):
            async with asyncio.timeout(PATIENCE_S):
                await move
        await asyncio.sleep(0)  # a move that has just ended tells its callback in the next turn
        error = move.exception()
        assert isinstance(error, RobotError), error
        return Outcome(error, noticed[0], stopped)

    async def stays_at_rest(self, seconds: float = 0.2) -> None:
        """Nothing moves by itself, and no control comes back by itself."""
        before = self.joints_rad()
        uploads = self.asked("upload")
        await asyncio.sleep(seconds)
        after = self.joints_rad()
        assert max(abs(a - b) for a, b in zip(before, after, strict=True)) < 1e-3
        assert self.asked("upload") == uploads
        assert not self.robot.control


MakeCell = Callable[..., Awaitable[Cell]]


@pytest.fixture
async def cell(
    controller: Callable[..., SimulatedController], control_path: ControlPath, tmp_path: Path
) -> AsyncIterator[MakeCell]:
    """`await cell("UR10e", control=True)`: connected, with control started as if by a person's go.

    Each test of it runs twice: with ur_rtde, and with the station's own script.
    """
    cells: list[Cell] = []

    async def make(model: str = "UR10", control: bool = True, **options: Any) -> Cell:
        running = await asyncio.to_thread(controller, model, **options)
        robot = UrRobot(RobotConfig(model=model, host=running.host, control=control_path), tmp_path / "log")
        made = Cell(running, running.admin(), robot)
        cells.append(made)
        made.start_heart()
        await robot.connect()
        if control:
            await robot.start_control()
        return made

    yield make
    for made in cells:
        await made.robot.close()
        await made.end()
        made.admin.close()


@pytest.fixture
def fault_times(request: pytest.FixtureRequest) -> Callable[[Outcome], None]:
    """Keeps measured times for docs/contributor/fault-tests.md: JSON lines in $FAULT_TIMES, if set."""

    def keep(outcome: Outcome) -> None:
        place = os.environ.get("FAULT_TIMES")
        if place:
            row = {
                "test": request.node.name,  # with the control path in brackets
                "noticed_ms": round(outcome.noticed_s * 1000),
                "stopped_ms": round(outcome.stopped_s * 1000),
                "error": str(outcome.error),
            }
            with Path(place).open("a") as lines:
                lines.write(json.dumps(row) + "\n")

    return keep


Struck = tuple[Cell, Outcome]
Strike = Callable[..., Awaitable[Struck]]


@pytest.fixture
def strike(cell: MakeCell, fault_times: Callable[[Outcome], None]) -> Strike:
    """`c, outcome = await strike(lambda c: fault(c), "UR10e")`: the fault in mid-move, of a cell made for it.

    Once more with another cell where the station's watchdog struck before the fault could: heart beating, but
    a process between here and the arm came too late. Any other outcome stands.
    """

    async def strike(fault: Callable[[Cell], object], model: str = "UR10") -> Struck:
        for left in reversed(range(TRIES)):
            made = None
            try:
                made = await cell(model)
                outcome = await made.strike(lambda made=made: fault(made))
            except RobotError:  # before the fault
                if not left:
                    raise
            else:
                overtaken = made.beating and outcome.error.code in set(Delay)
                if not overtaken or not left:
                    fault_times(outcome)
                    return made, outcome
            if made is not None:
                await made.robot.close()
                await made.end()
                check_allow_list(made.controller.host)
                made.controller.stop()
        raise AssertionError("not reached")

    return strike


@pytest.fixture
async def camera(
    controller: Callable[..., SimulatedController], tmp_path: Path
) -> AsyncIterator[RenderedCamera]:
    """Opened, before the published cell's arm."""
    cell = make_cell("paper-binned")
    write_truth(cell, tmp_path / "truth.json")
    rendered = RenderedCamera(cell, controller(truth=tmp_path / "truth.json").host)
    await rendered.open()
    yield rendered
    await rendered.close()
