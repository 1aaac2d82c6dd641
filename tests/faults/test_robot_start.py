"""Control has started when a heartbeat was heard. Whatever comes in between ends it, with its cause."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from typing import Any

import pytest

from station.cell.errors import RobotError
from station.devices.ur import UrRobot
from tests.codes import raises
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.process

Make = Callable[..., Awaitable[Any]]
Start = Callable[..., Awaitable[tuple[Any, asyncio.Task[None]]]]


@pytest.fixture
async def unheard(cell: Make) -> AsyncIterator[Start]:
    """`await unheard("UR10")`: control starts, its program runs, and no heartbeat has come yet."""

    async def start(model: str = "UR10") -> tuple[Any, asyncio.Task[None]]:
        c = await cell(model, control=False)
        c.beating = False
        starting = asyncio.create_task(c.robot.start_control())
        await until(lambda: c.admin.ask("state")["runtime_state"] == "PLAYING")
        await asyncio.sleep(0.3)  # the process says it is ready
        assert not starting.done() and not c.robot.control
        return c, starting

    yield start


async def ends(starting: asyncio.Task[None]) -> str:
    """Why: the error's code."""
    with pytest.raises(RobotError) as caught:
        async with asyncio.timeout(PATIENCE_S):
            await starting
    return caught.value.code


async def gone(c: Any) -> None:
    """Nothing of control is left, nothing moved, and a new go works."""
    await c.robot.idle()
    assert not c.robot.control and c.robot.control_pid is None
    await c.stays_at_rest()
    assert c.asked("move") == 0


def is_well(robot: UrRobot) -> bool:
    """The link is back, the dashboard's too."""
    with suppress(RobotError):
        robot.check()
        return robot.connected
    return False


async def test_a_move_right_after_the_start_is_taken(cell: Make) -> None:
    c = await cell(control=False)
    for _ in range(3):
        await c.robot.start_control()
        goal = c.joints_rad()
        goal[5] += 0.02
        await c.robot.move(goal, 0.5, 1.0)
        await c.robot.end_control()


async def test_a_move_waits_for_a_session_that_was_busy_for_a_moment(cell: Make) -> None:
    c = await cell(time_scale=0.5)  # the arm's watchdog waits twice as long: only the child's limit is passed
    goal = c.joints_rad()
    goal[5] += 0.02
    c.beating = False
    await asyncio.sleep(0.12)  # too old for a move, too young for the watchdog
    asyncio.get_running_loop().call_later(0.03, setattr, c, "beating", True)
    await c.robot.move(goal, 0.5, 1.0)


async def test_a_stop_before_the_move_was_sent(cell: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    c = await cell()
    goal, heard = c.far_goal(), c.robot._child.heard
    stops: list[asyncio.Task[None]] = []

    async def stop_comes_now() -> None:
        await heard()
        stops.append(asyncio.create_task(c.robot.stop("changed my mind")))
        await asyncio.sleep(0)

    monkeypatch.setattr(c.robot._child, "heard", stop_comes_now)
    with raises("stopped"):
        await c.robot.move(goal, 0.5, 1.0)
    await stops[0]
    await gone(c)


async def test_a_heart_that_does_not_beat_ends_the_start(unheard: Start) -> None:
    c, starting = await unheard()
    assert await ends(starting) == "no-heartbeat"
    await gone(c)
    c.beating = True
    await c.robot.start_control()


async def test_a_heart_that_beats_late_is_in_time(unheard: Start) -> None:
    c, starting = await unheard()
    c.beating = True
    await starting
    assert c.robot.control


async def test_stop_while_no_heartbeat_was_heard(unheard: Start) -> None:
    c, starting = await unheard()
    await c.robot.stop("changed my mind")
    assert await ends(starting) == "stopped"
    await gone(c)


@pytest.mark.parametrize("beating", [True, False])
async def test_a_protective_stop_while_no_heartbeat_was_heard(unheard: Start, beating: bool) -> None:
    c, starting = await unheard()
    c.admin.ask("pstop")
    await c.told()
    c.beating = beating
    assert await ends(starting) == "protective-stop"
    await gone(c)


@pytest.mark.parametrize(
    ("kill", "code"), [(signal.SIGSEGV, "control-process"), (signal.SIGSTOP, "control-process")]
)
async def test_a_control_process_that_fails_before_the_first_heartbeat(
    unheard: Start, kill: signal.Signals, code: str
) -> None:
    c, starting = await unheard()
    os.kill(c.robot.control_pid, kill)
    c.beating = True
    assert await ends(starting) == code
    await gone(c)


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ({"cmd": "drop", "how": "rst"}, "stopped"),
        ({"cmd": "black_hole"}, "stale-state"),
        ({"cmd": "restart", "down_s": 0.5, "running": True}, "stopped"),
    ],
    ids=["link cut", "cable pulled", "controller restarts"],
)
async def test_a_link_that_fails_before_the_first_heartbeat(
    unheard: Start, fault: dict[str, Any], code: str
) -> None:
    c, starting = await unheard()
    c.admin.ask(**fault)
    c.beating = True
    assert await ends(starting) == code
    if fault["cmd"] == "black_hole":
        # Nobody could tell the controller: its program waits, moves nothing, and is not silently replaced.
        await c.robot.idle()
        c.admin.ask("black_hole", on=False)
        await until(lambda: is_well(c.robot))
        with raises("foreign-program"):
            await c.robot.start_control()
        await c.robot.stop("operator")
    await until(lambda: c.admin.ask("state")["program"] is None)
    await gone(c)


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ({"cmd": "stop_program"}, "program-ended"),
        ({"cmd": "remote", "on": False}, "local-control"),
    ],
)
async def test_the_pendant_before_the_first_heartbeat(
    unheard: Start, fault: dict[str, Any], code: str
) -> None:
    c, starting = await unheard("UR10e")
    c.admin.ask(**fault)
    await c.told()
    c.beating = True
    assert await ends(starting) == code
    await gone(c)


async def test_a_cancelled_start_leaves_nothing(unheard: Start) -> None:
    c, starting = await unheard()
    starting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await starting
    await gone(c)
