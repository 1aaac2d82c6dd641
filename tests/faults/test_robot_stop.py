"""STOP: two paths, from any state, and for good. What leaves in the call itself: test_ur_stop.py."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path

import pytest

from station.cell.config import RobotConfig
from station.cell.errors import RobotError
from station.devices.ur import UrRobot
from tests.codes import raises
from tests.faults.conftest import MakeCell
from tests.patience import until

pytestmark = pytest.mark.process


async def test_stop_in_mid_move(cell: MakeCell) -> None:
    c = await cell("UR10e")
    move = await c.cruising()
    await c.robot.stop("operator")
    with raises("stopped"):
        await move
    await c.stops()
    await c.stays_at_rest()
    with raises("control-not-started"):
        await c.robot.move(c.near(), 0.5, 1.0)


@pytest.mark.parametrize("silent", [False, True], ids=["first connection", "new connection"])
async def test_with_a_hung_child_the_dashboard_stops_the_arm(
    cell: MakeCell, monkeypatch: pytest.MonkeyPatch, silent: bool
) -> None:
    c = await cell()

    async def no_other() -> None:
        return None

    move, loop = await c.cruising(), asyncio.get_running_loop()
    if silent:
        monkeypatch.setattr(c.robot.link.dashboard, "send", lambda command: loop.create_future())
    else:
        monkeypatch.setattr(c.robot.stops, "_dashboard_stop_anew", no_other)
    os.kill(c.control_pid, signal.SIGSTOP)
    await c.robot.stop("operator")
    await c.stops()
    assert await c.asked("stop") == 0 and await c.asked("dashboard: stop") >= 1
    with pytest.raises(RobotError):
        await move


async def test_with_a_silent_dashboard_the_child_stops_the_arm(cell: MakeCell) -> None:
    c = await cell()
    await c.ask("mute", ports=["dashboard"])
    move = await c.cruising()
    await c.robot.stop("operator")
    await c.stops()
    assert await c.asked("stop") == 1
    with pytest.raises(RobotError):
        await move


async def test_stop_is_welcome_in_any_state(cell: MakeCell, tmp_path: Path) -> None:
    stranger = UrRobot(RobotConfig(model="UR10", host="127.255.3.9"), tmp_path / "log")
    await stranger.stop("never connected")
    await stranger.link.close()
    c = await cell(control=False)
    await c.robot.stop("no control")
    await c.begin()
    await asyncio.gather(*(c.robot.stop(f"number {i}") for i in range(5)))
    await c.robot.stop("again")
    await c.stays_at_rest()
    await c.robot.link.close()
    await c.robot.stop("closed")


async def test_stop_while_control_starts(cell: MakeCell) -> None:
    c = await cell(control=False)
    start = asyncio.create_task(c.robot.start_control())
    await until(lambda: c.control_pid is not None)
    await c.robot.stop("changed my mind")
    with raises("stopped"):
        await start
    await asyncio.sleep(0.4)
    await c.until(lambda state: state["program"] is None)
    assert not c.robot.control and c.control_pid is None


async def test_stop_before_the_control_process_exists(
    cell: MakeCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    c = await cell(control=False)
    checks = c.robot.may_start

    async def stop_comes_now() -> None:
        await checks()
        await c.robot.stop("changed my mind")

    monkeypatch.setattr(c.robot, "may_start", stop_comes_now)
    with raises("stopped"):
        await c.robot.start_control()
    assert c.control_pid is None and await c.asked("upload") == 0


async def test_a_cancelled_move_stops_the_arm(cell: MakeCell) -> None:
    c = await cell()
    move = await c.cruising()
    move.cancel()
    with pytest.raises(asyncio.CancelledError):
        await move
    await c.stops()
    await c.stays_at_rest()
