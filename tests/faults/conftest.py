"""A simulated arm behind the driver, with the heartbeat of a session's loop: `c = await cell()`.

Nothing in that loop may wait: whoever asks the controller does so from a thread, or the heartbeat would stop.
"""

from __future__ import annotations

import asyncio
import inspect
import json
import math
import os
import signal
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from recordings.schema.messages import RobotState
from station.cell.config import ControlPath, RobotConfig
from station.cell.errors import RobotError, StaleStateError
from station.devices.news import Delay
from station.devices.ur import UrRobot
from station.simulation.launch import SimulatedController
from tests.conftest import AT_REST_RAD_S, asked, rests_short_of_its_goal
from tests.patience import PATIENCE_S, until

FAR_RAD = 1.5
BEAT_S, POLL_S = 0.03, 0.005
Json = dict[str, Any]


class Cell:
    def __init__(self, controller: SimulatedController, robot: UrRobot, name: str) -> None:
        self.controller, self.robot, self.name = controller, robot, name
        self.beating = True
        self._admin, self._asking = controller.admin(), asyncio.Lock()
        self._heart = asyncio.create_task(self._beat())

    @property
    def control_pid(self) -> int | None:
        return self.robot._child.pid if self.robot._child is not None else None

    async def _beat(self) -> None:
        while True:
            if self.beating:
                self.robot.heartbeat()
            await asyncio.sleep(BEAT_S)

    async def end(self) -> None:
        await self.robot.link.close()
        self._heart.cancel()
        self._admin.close()

    async def _in_thread(self, ask: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        async with self._asking:
            return await asyncio.to_thread(ask, *arguments, **named)

    async def ask(self, cmd: str, **how: Any) -> Json:
        """Tell the controller, by its back door."""
        answer: Json = await self._in_thread(self._admin.ask, cmd, **how)
        return answer

    async def until(self, condition: Callable[[Json], object]) -> None:
        """Wait for a state of the controller, by its own account."""
        async with asyncio.timeout(PATIENCE_S):
            while not condition(await self.ask("state")):
                await asyncio.sleep(0.002)

    async def joints_rad(self) -> list[float]:
        joints: list[float] = (await self.ask("state"))["joints_rad"]
        return joints

    async def asked(self, what: str) -> int:
        """See `asked`: a key of the log's counts, or upload, move, stop."""
        count: int = await self._in_thread(asked, self._admin, what)
        return count

    async def told(self) -> None:
        """What was done before has reached the driver."""
        done_s = (await self.ask("state"))["timestamp_s"]
        await until(lambda: (self.seen().stamps.controller_s or 0.0) > done_s)

    def seen(self) -> RobotState:
        """The newest state that reached the driver, however old."""
        return self.robot.link.states.sample(math.inf, connected=False).state

    def near(self, joint: int = 5, by_rad: float = 0.02) -> list[float]:
        goal = list(self.seen().joints_rad)
        goal[joint] += by_rad
        return goal

    def far_move(self) -> asyncio.Task[None]:
        """A move of several seconds, under way."""
        return asyncio.create_task(self.robot.move(self.near(0, FAR_RAD), 0.5, 1.0))

    async def begin(self) -> None:
        """Start control, as a person would: again, where late news of a busy computer prevented it."""
        async with asyncio.timeout(PATIENCE_S):
            while not await self._in_time(self.robot.start_control()):
                pass

    async def go_on(self, move: asyncio.Task[None]) -> bool:
        """Begin again after a move that late news ended (True); raise what else ended it."""
        if await self._in_time(move):
            return False
        await self.begin()
        return True

    async def _in_time(self, doing: Awaitable[object]) -> bool:
        try:
            await doing
        except StaleStateError as error:
            if error.code not in set(Delay):
                raise
            return False
        return True

    async def arrives(self, goal: Sequence[float], speed_rad_s: float = 0.5) -> None:
        """Move to joints, on however busy a computer."""
        while max(abs(a - b) for a, b in zip(await self.joints_rad(), goal, strict=True)) > 1e-3:
            await self.go_on(asyncio.create_task(self.robot.move(goal, speed_rad_s, 1.0)))

    async def cruising(self) -> asyncio.Task[None]:
        """A move that has reached its full speed."""
        while True:
            goal = self.seen().joints_rad[0] + FAR_RAD
            move = self.far_move()
            while not move.done() and self.seen().joint_speeds_rad_s[0] < 0.4:
                await asyncio.sleep(POLL_S)
            if not move.done():
                return move
            await self.go_on(move)
            assert (await self.joints_rad())[0] < goal - 0.1, "the arm arrived before it was at full speed"

    async def stops(self) -> None:
        """Before it has arrived."""
        await self.until(lambda state: max(map(abs, state["joint_speeds_rad_s"])) < AT_REST_RAD_S)
        await self._in_thread(rests_short_of_its_goal, self._admin)

    async def stops_anywhere(self) -> None:
        """Also where it had hardly begun, or was as good as there."""
        await self.until(lambda state: not state["moving"] and state["program"] is None)

    async def strike(self, fault: Json | Callable[[Cell], object]) -> RobotError:
        """The fault in mid-move, asked of the controller or done. The arm stops before its goal; why."""
        move = await self.cruising()
        begun = time.monotonic()
        stopping = asyncio.create_task(self.stops())
        doing = self.ask(**fault) if isinstance(fault, dict) else fault(self)
        if inspect.isawaitable(doing):
            await doing
        with pytest.raises(RobotError) as caught:
            async with asyncio.timeout(PATIENCE_S):
                await move
        noticed_s = time.monotonic() - begun
        await stopping
        self.note_times(noticed_s, time.monotonic() - begun)
        return caught.value

    def note_times(self, noticed_s: float, stopped_s: float) -> None:
        """For docs/contributor/fault-tests.md: a JSON line in $FAULT_TIMES, if set."""
        if place := os.environ.get("FAULT_TIMES"):
            times = {"noticed_ms": round(noticed_s * 1000), "stopped_ms": round(stopped_s * 1000)}
            with Path(place).open("a") as lines:
                lines.write(json.dumps({"test": self.name} | times) + "\n")

    async def stays_at_rest(self, seconds: float = 0.2) -> None:
        """Nothing moves by itself, and no control comes back by itself."""
        before, uploads = await self.joints_rad(), await self.asked("upload")
        await asyncio.sleep(seconds)
        assert max(abs(a - b) for a, b in zip(await self.joints_rad(), before, strict=True)) < 1e-3
        assert await self.asked("upload") == uploads
        assert not self.robot.control


MakeCell = Callable[..., Awaitable[Cell]]


@pytest.fixture
async def cell(
    controller: Callable[..., SimulatedController],
    control_path: ControlPath,
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> AsyncIterator[MakeCell]:
    """`await cell("UR10e", control=True)`: connected, with control started as if by a person's approval.

    Each test of it runs twice: with ur_rtde, and with the station's own script.
    """
    cells: list[Cell] = []

    async def make(model: str = "UR10", control: bool = True, **options: Any) -> Cell:
        running = await asyncio.to_thread(controller, model, **options)
        robot = UrRobot(RobotConfig(model=model, host=running.host, control=control_path), tmp_path / "log")
        made = Cell(running, robot, request.node.name)
        cells.append(made)
        await robot.link.connect()
        if control:
            await made.begin()
        return made

    yield make
    for made in cells:
        await made.end()


def child_gets(number: signal.Signals) -> Callable[[Cell], None]:
    return lambda c: os.kill(c.control_pid, number)
