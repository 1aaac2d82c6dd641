"""A stop leaves by both ways in the very call, before anything is waited for, whatever hangs behind it."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock, Mock

import pytest

from station.cell.config import RobotConfig
from station.cell.errors import RobotError
from station.devices.rtde import RuntimeState
from station.devices.ur import UrRobot
from station.devices.ur.dashboard import STOP
from tests.codes import raises
from tests.patience import PATIENCE_S


class Ways:
    """In place of dashboard and control process: what reached them, in order; neither answers by itself."""

    def __init__(self) -> None:
        self.log: list[str] = []
        self.alive = True
        self.started_s = time.monotonic()
        self.ended = asyncio.Event()
        self.reply: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self.stop_acknowledged: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def send(self, command: str) -> asyncio.Future[str]:
        self.log.append(f"dashboard {command}")
        return self.reply

    def stop(self) -> None:
        self.log.append("child stop")

    async def end_after_stop(self, moment_s: float) -> None:
        self.log.append("child ends")

    async def end(self) -> None:
        await self.ended.wait()
        self.log.append("child ends")

    async def anew(self) -> None:
        self.log.append("dashboard anew")


@pytest.fixture
async def ways() -> Ways:
    return Ways()


@pytest.fixture
async def robot(ways: Ways, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr("station.devices.ur.robot.LEFTOVER_WAIT_S", 0)
    made: Any = UrRobot(RobotConfig(model="UR10", host="127.0.0.1"), tmp_path)
    monkeypatch.setattr(made.stops, "_dashboard_stop_anew", ways.anew)
    made.link.dashboard, made._child, made.control = ways, ways, True
    return made


async def test_both_ways_are_taken_before_anything_is_waited_for(robot: Any, ways: Ways) -> None:
    stopping = asyncio.ensure_future(robot.stop("STOP by anna"))
    await asyncio.sleep(0)
    assert ways.log[:2] == ["child stop", f"dashboard {STOP}"]
    assert not robot.control, "no move is taken from here on"
    ways.reply.set_result("Stopped")
    ways.stop_acknowledged.set_result(None)
    await stopping
    await robot.stops.idle()
    assert ways.log[2:] == ["child ends"]


async def test_a_dashboard_that_does_not_answer_is_asked_by_a_new_connection(robot: Any, ways: Ways) -> None:
    await robot.stop("STOP by anna")
    await robot.stops.idle()
    assert sorted(ways.log[2:]) == ["child ends", "dashboard anew"]


@pytest.mark.parametrize("alive", [True, False])
async def test_without_control_of_ours_the_dashboard_stops_what_runs(
    robot: Any, ways: Ways, alive: bool
) -> None:
    robot._child, ways.alive = None, alive
    ways.reply.set_result("Stopped")
    await robot.stop("STOP by anna")
    await robot.stops.idle()
    assert ways.log == [f"dashboard {STOP}" if alive else "dashboard anew"]


@pytest.mark.parametrize("broken", ["send", "stop"])
async def test_a_way_that_breaks_in_the_call_costs_neither_the_other_nor_the_end_of_control(
    robot: Any, ways: Ways, broken: str
) -> None:
    setattr(ways, broken, Mock(side_effect=RuntimeError("a defect")))
    await robot.stop("STOP by anna")
    await robot.stops.idle()
    other = "child stop" if broken == "send" else f"dashboard {STOP}"
    assert ways.log[0] == other and sorted(ways.log[1:]) == ["child ends", "dashboard anew"]


def shows(robot: Any, *states: RuntimeState) -> None:
    """Give these states of the program, one a look."""
    left = [SimpleNamespace(runtime_state=state) for state in states]

    async def state_after(moment_s: float, wait_s: float) -> Any:
        await asyncio.sleep(moment_s - time.monotonic())
        return left.pop(0) if left else None

    robot.link.states.state_after = state_after


@pytest.mark.parametrize("ready", [True, False])
async def test_a_program_that_starts_only_after_its_process_was_killed_is_stopped(
    robot: Any, ways: Ways, monkeypatch: pytest.MonkeyPatch, ready: bool
) -> None:
    """Killed before it was ready, its upload may be on the way; later nothing can start any more."""
    monkeypatch.setattr("station.devices.ur.robot.UPLOADED_S", PATIENCE_S)
    ways.started_s *= ready
    shows(robot, RuntimeState.STOPPED, RuntimeState.STOPPED, RuntimeState.PLAYING)
    ways.ended.set()
    await robot.end_control()
    assert ways.log == ["child ends", *([] if ready else ["dashboard anew"])]


async def test_so_is_one_that_starts_only_after_a_stop(
    robot: Any, ways: Ways, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("station.devices.ur.robot.UPLOADED_S", PATIENCE_S)
    ways.started_s = 0.0
    shows(robot, RuntimeState.STOPPED, RuntimeState.PLAYING)
    ways.reply.set_result("Stopped")
    await robot.stop("STOP by anna")
    await robot.stops.idle()
    assert ways.log[2:] == ["child ends", "dashboard anew"]


async def test_control_starts_when_the_last_one_has_ended(
    robot: Any, ways: Ways, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "station.devices.ur.robot.wait_for_state", looks := AsyncMock(side_effect=RobotError("no-host"))
    )
    robot._child = None
    robot.stops.later(ways.end())
    starting = asyncio.create_task(robot.start_control())
    await asyncio.sleep(0.01)
    assert not looks.called
    ways.ended.set()
    with raises("no-host"):
        await starting


async def test_an_end_of_control_that_is_cancelled_is_carried_out(robot: Any, ways: Ways) -> None:
    shows(robot, RuntimeState.PLAYING)
    ending = asyncio.create_task(robot.end_control())
    await asyncio.sleep(0)
    for _ in range(2):
        ending.cancel()
        await asyncio.wait({ending})
    ways.ended.set()
    await robot.stops.idle()
    assert ways.log == ["child ends", "dashboard anew"]
