"""Control has started when a heartbeat was heard. Whatever comes in between ends it, with its cause."""

from __future__ import annotations

import asyncio
import signal
from contextlib import suppress
from typing import Any

import pytest

from station.cell.errors import RobotError
from station.devices.ur import UrRobot
from station.devices.ur.stream import StateReader
from tests.codes import raises
from tests.faults.conftest import Cell, MakeCell, child_gets
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.process


async def unheard(cell: MakeCell, model: str = "UR10") -> tuple[Cell, asyncio.Task[None]]:
    """Control starts, its program runs, and no heartbeat has come yet."""
    c = await cell(model, control=False)
    c.beating = False
    starting = asyncio.create_task(c.robot.start_control())
    await c.until(lambda state: state["runtime_state"] == "PLAYING")
    await asyncio.sleep(0.3)  # the process says it is ready
    assert not starting.done() and not c.robot.control
    return c, starting


async def gone(c: Cell) -> None:
    """Nothing of control is left, and nothing moved."""
    await c.robot.stops.idle()
    assert not c.robot.control and c.control_pid is None
    await c.stays_at_rest()
    assert await c.asked("move") == 0


def is_well(robot: UrRobot) -> bool:
    """The link is back, the dashboard's too."""
    with suppress(RobotError):
        robot.link.check(robot.link.state())
        return robot.link.states.connected
    return False


async def test_a_move_is_not_judged_by_news_from_before_the_start(
    cell: MakeCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A busy computer takes states 80 ms after they arrived: current, but of an arm without a program."""
    c = await cell(control=False)
    take, loop = StateReader._take, asyncio.get_running_loop()
    monkeypatch.setattr(StateReader, "_take", lambda *state: loop.call_later(0.08, take, *state))
    await asyncio.sleep(0.2)
    for _ in range(2):
        await c.begin()
        await c.arrives(c.near())
        await c.robot.end_control()


async def test_a_move_waits_for_a_session_that_was_busy_for_a_moment(cell: MakeCell) -> None:
    c = await cell(time_scale=0.5)  # the arm's watchdog waits twice as long: only the child's limit is passed
    async with asyncio.timeout(PATIENCE_S):
        late = True
        while late:  # a computer that is busy itself holds the beats up for longer than asked here
            c.beating = False
            await asyncio.sleep(0.12)  # too old for a move, too young for the watchdog
            asyncio.get_running_loop().call_later(0.03, setattr, c, "beating", True)
            late = await c.go_on(asyncio.create_task(c.robot.move(c.near(), 0.5, 1.0)))


async def test_a_stop_before_the_move_was_sent(cell: MakeCell, monkeypatch: pytest.MonkeyPatch) -> None:
    c = await cell()
    heard = c.robot._child.heard
    stops: list[asyncio.Task[None]] = []

    async def stop_comes_now() -> None:
        await heard()
        stops.append(asyncio.create_task(c.robot.stop("changed my mind")))
        await asyncio.sleep(0)

    monkeypatch.setattr(c.robot._child, "heard", stop_comes_now)
    with raises("stopped"):
        await c.far_move()
    await stops[0]
    await gone(c)


BEFORE_THE_FIRST: dict[str, tuple[Any, bool, str]] = {
    "no heartbeat": (lambda c: None, False, "no-heartbeat"),
    "STOP": (lambda c: c.robot.stop("changed my mind"), False, "stopped"),
    "protective stop": (lambda c: c.ask("pstop"), True, "protective-stop"),
    "protective stop, no heartbeat": (lambda c: c.ask("pstop"), False, "protective-stop"),
    "child segfault": (child_gets(signal.SIGSEGV), True, "control-process"),
    "child held up": (child_gets(signal.SIGSTOP), True, "control-process"),
    "program stopped": (lambda c: c.ask("stop_program"), True, "program-ended"),
    "local control": (lambda c: c.ask("remote", on=False), True, "local-control"),
    "link cut": (lambda c: c.ask("drop", how="rst"), True, "stopped"),
    "cable pulled": (lambda c: c.ask("black_hole"), True, "stale-state"),
    "controller restarts": (lambda c: c.ask("restart", down_s=0.5, running=True), True, "stopped"),
}
"""What happens before the first heartbeat; does one come then? how the start ends"""


@pytest.mark.parametrize("name", BEFORE_THE_FIRST)
async def test_before_the_first_heartbeat(cell: MakeCell, name: str) -> None:
    happens, beats, code = BEFORE_THE_FIRST[name]
    c, starting = await unheard(cell, "UR10e")
    if (doing := happens(c)) is not None:
        await doing
    if code in ("protective-stop", "program-ended", "local-control"):
        await c.told()
    c.beating = beats
    with pytest.raises(RobotError) as ended:
        async with asyncio.timeout(PATIENCE_S):
            await starting
    # On a busy computer the simulated controller is truly late, and that comes before an ended program.
    assert ended.value.code in (code, *(["controller-late"] if code == "program-ended" else []))
    if name == "cable pulled":
        # Nobody could tell the controller: its program waits, moves nothing, and is not silently replaced.
        await c.robot.stops.idle()
        await c.ask("black_hole", on=False)
        await until(lambda: is_well(c.robot))
        with raises("foreign-program"):
            await c.robot.start_control()
        await c.robot.stop("operator")
    if code != "protective-stop":
        await c.until(lambda state: state["program"] is None)
    await gone(c)


async def test_a_cancelled_start_leaves_nothing_and_control_can_be_started_again(cell: MakeCell) -> None:
    c, starting = await unheard(cell)
    starting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await starting
    await gone(c)
    c.beating = True
    await c.begin()
