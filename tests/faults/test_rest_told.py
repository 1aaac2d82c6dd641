"""After STOP an arm is told to rest only when it does, over a network that takes its time, too."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from station.cell.config import ControlPath, RobotConfig
from station.cell.errors import RobotError
from station.cell.stillness import RESTING_RAD_S, fastest_rad_s
from station.devices.ur import UrRobot
from station.simulation.launch import SimulatedController
from tests.delayed_link import delayed_link
from tests.faults.conftest import FAR_RAD, Cell
from tests.patience import until

pytestmark = pytest.mark.process

DELAY_S = 0.02
RACES = 6
"""Where every state counts as one from after the stop, most of them tell rest too early."""
CREPT_RAD = 5e-5
"""An arm that counts as resting, below 0.01 rad/s, and brakes with 4 rad/s², moves by a quarter of this."""


def rests(robot: UrRobot) -> bool:
    """Tell whether the newest state says that the arm rests, as the daemon decides it after STOP."""
    try:
        state = robot.link.state()
    except RobotError:
        return False
    return fastest_rad_s(state) <= RESTING_RAD_S and robot.after_stop(state)


@pytest.mark.parametrize("seed", range(RACES))
async def test_rest_is_told_by_the_controllers_clock(
    controller: Callable[..., SimulatedController], control_path: ControlPath, tmp_path: Path, seed: int
) -> None:
    """STOP comes early in a move, while states from before the move are still on their way."""
    running = await asyncio.to_thread(controller, "UR10e")
    with delayed_link(running.host, DELAY_S) as host:
        robot = UrRobot(RobotConfig(model="UR10e", host=host, control=control_path), tmp_path / "log")
        c = Cell(running, robot, f"rest told {seed}")
        try:
            await robot.link.connect()
            await c.begin()
            move = asyncio.create_task(robot.move(c.near(0, FAR_RAD), 1.0, 1.5))
            await c.until(lambda state: state["moving"])  # by the controller's own account, without a delay
            await asyncio.sleep(random.Random(seed).uniform(0.0, DELAY_S))
            stopping = asyncio.create_task(robot.stop("operator"))
            await asyncio.sleep(0)
            await until(lambda: rests(robot))
            told_ns = time.monotonic_ns()
            await stopping
            await asyncio.wait([move])
            await c.stops_anywhere()
            at_told = (await c.ask("truth", at_monotonic_ns=told_ns))["joints_rad"]
            now = await c.joints_rad()
            assert max(abs(a - b) for a, b in zip(at_told, now, strict=True)) < CREPT_RAD
            assert isinstance(move.exception(), RobotError)
        finally:
            await c.end()


async def test_a_stop_that_nothing_confirms_counts_as_arrived_once_the_watchdog_has_struck(
    controller: Callable[..., SimulatedController], tmp_path: Path
) -> None:
    """A dashboard that does not answer: the arm is told to rest all the same, later."""
    running = await asyncio.to_thread(controller, "UR10")
    robot = UrRobot(RobotConfig(model="UR10", host=running.host, control="script"), tmp_path / "log")
    c = Cell(running, robot, "unconfirmed")
    try:
        await robot.link.connect()
        await c.begin()
        await c.cruising()
        await c.ask("mute", ports=["dashboard"])
        await robot.stop("operator")
        assert not rests(robot)
        await until(lambda: rests(robot))
        await c.stops()
    finally:
        await c.end()
