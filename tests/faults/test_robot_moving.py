"""Faults in mid-move: the arm stops, the operator reads why and what to do, nothing goes on by itself."""

from __future__ import annotations

import asyncio
import os
import signal
from contextlib import suppress
from typing import Any

import pytest

from station.cell.errors import RobotError, SafetyStopError, StaleStateError
from station.devices.base import wait_for_state
from station.devices.news import Delay
from station.devices.ur.child import ControlChild
from tests.codes import raises
from tests.faults.conftest import Cell, MakeCell, child_gets
from tests.patience import until

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    ("model", "fault", "code"),
    [
        ("UR10", "pstop", "protective-stop"),
        ("UR10e", "safeguard", "safeguard-stop"),
        ("UR10", "estop", "emergency-stop"),
        ("UR10e", "estop", "emergency-stop"),  # its robot mode is another then
    ],
)
async def test_safety_stop(cell: MakeCell, model: str, fault: str, code: str) -> None:
    c = await cell(model)
    error = await c.strike({"cmd": fault})
    assert isinstance(error, SafetyStopError)
    assert error.code == code and error.remedy
    await c.stays_at_rest()
    with pytest.raises(SafetyStopError):
        await c.robot.start_control()


def heart_stands_still(c: Cell) -> None:
    c.beating = False


def cut(how: str, ports: list[str] | None) -> dict[str, Any]:
    return {"cmd": "drop", "how": how, "ports": ports}


FAULTS: dict[str, tuple[Any, str]] = {
    "program stopped": ({"cmd": "stop_program"}, "program-ended"),
    "power off": ({"cmd": "power_off"}, "not-powered"),
    "remote control lost": ({"cmd": "remote", "on": False}, "local-control"),
    "TCP": ({"cmd": "tcp", "pose": [0.0, 0.0, 0.002, 0.0, 0.0, 0.0]}, "tcp-changed"),
    "payload": ({"cmd": "payload", "kg": 1.5}, "payload-changed"),
    "every link cut, RST": (cut("rst", None), "link-lost"),
    "rtde links cut, FIN": (cut("fin", ["rtde"]), "link-lost"),
    "silent link": ({"cmd": "stall"}, "stale-state"),
    "frozen data": ({"cmd": "freeze"}, "stale-state"),
    "cable pulled": ({"cmd": "black_hole"}, "stale-state"),
    "controller restarts": ({"cmd": "restart", "down_s": 0.5, "running": True}, "link-lost"),
    "child segfault": (child_gets(signal.SIGSEGV), "control-process"),
    "child held up": (child_gets(signal.SIGSTOP), "computer-late"),
    "session loop stalls": (heart_stands_still, "computer-late"),
}


@pytest.mark.parametrize("name", FAULTS)
async def test_fault(cell: MakeCell, name: str) -> None:
    fault, code = FAULTS[name]
    c = await cell("UR10e" if code == "local-control" else "UR10")
    child_pid = c.control_pid
    error = await c.strike(fault)
    late_too = (name, error.code) == (
        "program stopped",
        Delay.CONTROLLER,
    )  # on a busy computer
    assert error.code == code or late_too, error
    if code == "stale-state":
        await c.ask(**fault, on=False)
    await until(lambda: c.robot.link.states.age_s() < 0.1)
    await c.until(lambda state: state["program"] is None)  # ur_rtde loads its program anew by itself
    await c.stays_at_rest(1.0 if code == "link-lost" else 0.2)
    with pytest.raises(ProcessLookupError):
        os.kill(child_pid, 0)


async def test_a_connection_heard_of_as_lost_only_later_is_what_is_told(
    cell: MakeCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The control process loses its own connection first: then nothing resets the watchdog any more."""

    async def heard_meanwhile(*_: object) -> RobotError:
        c.robot.on_link_lost("the robot closed the connection")
        return StaleStateError(Delay.COMPUTER)

    c = await cell()
    monkeypatch.setattr("station.devices.ur.robot.cause_of_end", heard_meanwhile)
    assert (await c.strike({"cmd": "stop_program"})).code == "link-lost"


@pytest.mark.parametrize(
    ("behind", "code"),
    [(None, "program-ended"), ("estop", "emergency-stop")],
)
async def test_a_refused_kick_is_told_as_what_is_behind_it(
    cell: MakeCell, behind: str | None, code: str
) -> None:
    """The control process may hear of the stopped program before the state stream tells what stopped it."""

    class Refused(ControlChild):
        """Whatever its next heartbeats are answered."""

        kicks_refused = property(lambda _: True, lambda *_: None)

    async def refuse(c: Cell) -> None:
        c.robot._child.__class__ = Refused
        if behind is not None:
            await c.ask(behind)

    c = await cell()
    found = (await c.strike(refuse)).code  # on a busy computer the simulated controller is truly late
    assert found == code or (found, code) == ("controller-late", "program-ended")
    await c.stays_at_rest()


async def test_the_switch_to_local_is_named_although_the_supervision_saw_it_first(cell: MakeCell) -> None:
    async def go_local(c: Cell) -> None:
        c.robot.link.remote = False
        await c.ask("remote", on=False)

    assert (await (await cell("UR10e")).strike(go_local)).code == "local-control"


@pytest.mark.parametrize(("told", "program"), [(True, "palletising.urp"), (False, "")])
async def test_another_clients_program_in_the_place_of_ours_is_named(
    cell: MakeCell, told: bool, program: str
) -> None:
    """By its name, where the primary interface tells it; else by a program that plays after ours ended."""
    c = await cell(control=False)
    if not told:
        await c.ask("mute", ports=["script30001"])
    await c.begin()

    async def replace(c: Cell) -> None:
        await c.ask("mute", ports=["dashboard"])  # whose stop would end that program before it begins
        await c.ask("foreign", name="palletising.urp")

    error = await c.strike(replace)
    assert error.code == "program-replaced" and error.values["program"] == program
    await c.stays_at_rest()


async def test_a_program_paused_on_the_pendant_does_not_go_on_when_play_is_pressed(cell: MakeCell) -> None:
    c = await cell()
    assert (await c.strike({"cmd": "pause"})).code == "program-ended"
    await c.until(lambda state: state["runtime_state"] == "STOPPED")
    await c.ask("play")
    await c.stays_at_rest()


async def test_a_lost_link_is_named_although_it_may_be_back_already(
    cell: MakeCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("station.devices.ur.robot.POLL_S", 1.0)  # a computer that looks again only then
    assert (await (await cell()).strike(cut("rst", None))).code == "link-lost"


async def test_a_control_process_held_up_between_two_moves_is_named_by_the_next(cell: MakeCell) -> None:
    c = await cell()
    control_pid, here = c.control_pid, await c.joints_rad()
    os.kill(control_pid, signal.SIGSTOP)
    await asyncio.sleep(0.4)
    with suppress(ProcessLookupError):  # the station may have ended it
        os.kill(control_pid, signal.SIGCONT)
    with pytest.raises(RobotError) as told:
        while True:
            await c.robot.move(here, 0.5, 1.0)
    assert told.value.code in set(Delay)  # on a busy computer the controller may be late, too


async def test_control_that_ended_between_two_moves_is_no_trouble_once_it_was_told(
    cell: MakeCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One approval continues at once, also before the next look at the robot."""
    monkeypatch.setattr("station.devices.ur.link.RETRY_S", 600.0)
    c = await cell()
    control_pid = c.control_pid
    os.kill(control_pid, signal.SIGSTOP)
    await until(lambda: c.robot._ended_by is not None)
    with pytest.raises(RobotError):
        await wait_for_state(c.robot.link, checked=True)
    await c.robot.end_control()
    await wait_for_state(c.robot.link, checked=True)
    await c.begin()


async def test_an_arm_that_goes_another_way_than_the_checked_one_is_stopped(
    cell: MakeCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    c = await cell()
    ask, before = ControlChild.move, await c.joints_rad()
    late = True

    async def elsewhere(self: ControlChild, joints_rad: list[float], *speeds: float) -> None:
        await ask(self, [joints_rad[0], joints_rad[1] - 0.6, *joints_rad[2:]], *speeds)

    monkeypatch.setattr(ControlChild, "move", elsewhere)
    with raises("off-path", joint=2):
        while late:  # a computer that is too busy ends the move before
            before = await c.joints_rad()
            late = await c.go_on(c.far_move())
    await c.stops()
    assert max(abs(a - b) for a, b in zip(await c.joints_rad(), before, strict=True)) < 0.5
    await c.stays_at_rest()


async def test_at_a_slow_slider_the_move_arrives(cell: MakeCell) -> None:
    c = await cell()
    await c.ask("slider", fraction=0.2)
    goal = c.near()
    move = asyncio.create_task(c.arrives(goal, 0.8))
    await until(lambda: c.robot.notice == "speed slider at 20 %")
    await move
    assert max(abs(a - b) for a, b in zip(await c.joints_rad(), goal, strict=True)) < 1e-3
    assert c.robot.notice == ""


async def test_at_slider_zero_the_arm_waits_and_the_operator_is_told(cell: MakeCell) -> None:
    c = await cell()
    while True:
        move = await c.cruising()
        await c.ask("slider", fraction=0.0)
        await until(lambda move=move: move.done() or "slider on the pendant is at 0" in c.robot.notice)
        await asyncio.sleep(0.3)
        waited = not move.done()
        await c.ask("slider", fraction=1.0)
        if not await c.go_on(move):  # late news of a busy computer did not end it
            assert waited
            return
