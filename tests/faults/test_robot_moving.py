"""Faults in mid-move: the arm stops, the operator reads why and what to do, nothing goes on by itself."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any

import pytest

from station.cell.errors import RobotError, SafetyStopError, StaleStateError
from station.devices.news import Delay
from station.devices.ur_child import ControlChild
from tests.codes import raises
from tests.patience import until

pytestmark = pytest.mark.process

Strike = Callable[..., Awaitable[Any]]


@pytest.mark.parametrize(
    ("fault", "code"),
    [("pstop", "protective-stop"), ("safeguard", "safeguard-stop"), ("estop", "emergency-stop")],
)
@pytest.mark.parametrize("model", ["UR10", "UR10e"])
async def test_safety_stop(strike: Strike, model: str, fault: str, code: str) -> None:
    c, outcome = await strike(lambda c: c.admin.ask(fault), model)
    assert isinstance(outcome.error, SafetyStopError)
    assert outcome.error.code == code and outcome.error.remedy
    await c.stays_at_rest()
    with pytest.raises(SafetyStopError):
        await c.robot.start_control()


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ({"cmd": "stop_program"}, "program-ended"),
        ({"cmd": "pause"}, "program-ended"),
        ({"cmd": "power_off"}, "not-powered"),
        ({"cmd": "remote", "on": False}, "local-control"),
        ({"cmd": "tcp", "pose": [0.0, 0.0, 0.002, 0.0, 0.0, 0.0]}, "tcp-changed"),
        ({"cmd": "payload", "kg": 1.5}, "payload-changed"),
    ],
    ids=["program stopped", "program paused", "power off", "remote control lost", "TCP", "payload"],
)
async def test_something_on_the_pendant(strike: Strike, fault: dict[str, Any], code: str) -> None:
    c, outcome = await strike(lambda c: c.admin.ask(**fault), "UR10e")
    assert outcome.error.code == code
    await c.stays_at_rest()


async def test_a_refused_kick_is_told_as_the_stopped_program_that_it_means(strike: Strike) -> None:
    """The control process may hear of it before the state stream tells."""

    class Refused(ControlChild):
        """Whatever its next heartbeats are answered."""

        kicks_refused = property(lambda _: True, lambda *_: None)

    def refuse(c: Any) -> None:
        c.robot._child.__class__ = Refused

    c, outcome = await strike(refuse)
    assert outcome.error.code == "program-ended"
    await c.stays_at_rest()


async def test_a_refused_kick_is_told_as_the_safety_stop_behind_it(strike: Strike) -> None:
    """The control process may hear of the stopped program before the state stream tells what stopped it."""
    cells: list[Any] = []

    class RefusedAsItIsPressed(ControlChild):
        @property
        def kicks_refused(self) -> bool:
            if cells:
                cells.pop().admin.ask("estop")
            return True

        @kicks_refused.setter
        def kicks_refused(self, _: bool) -> None:
            pass

    def press(c: Any) -> None:
        cells.append(c)
        c.robot._child.__class__ = RefusedAsItIsPressed

    c, outcome = await strike(press)
    assert outcome.error.code == "emergency-stop"
    await c.stays_at_rest()


async def test_the_switch_to_local_is_named_although_the_supervision_saw_it_first(strike: Strike) -> None:
    def go_local(c: Any) -> None:
        c.admin.ask(cmd="remote", on=False)
        c.robot.remote = False

    _, outcome = await strike(go_local, "UR10e")
    assert outcome.error.code == "local-control"


@pytest.mark.parametrize(("told", "program"), [(True, "palletising.urp"), (False, "")])
async def test_another_clients_program_in_the_place_of_ours_is_named(
    cell: Callable[..., Awaitable[Any]], told: bool, program: str
) -> None:
    """By its name, where the primary interface tells it; else by a program that plays after ours ended."""
    c = await cell(control=False)
    if not told:
        c.admin.ask("mute", ports=["script30001"])
    await c.robot.start_control()

    def replace() -> None:
        c.admin.ask("mute", ports=["dashboard"])  # whose stop would end that program before it begins
        c.admin.ask("foreign", name="palletising.urp")

    outcome = await c.strike(replace)
    assert outcome.error.code == "program-replaced"
    assert outcome.error.values["program"] == program
    assert outcome.stopped_s < 0.6
    await c.stays_at_rest()


async def test_a_program_paused_on_the_pendant_does_not_go_on_when_play_is_pressed(strike: Strike) -> None:
    c, _ = await strike(lambda c: c.admin.ask("pause"))
    await until(lambda: c.admin.ask("state")["runtime_state"] == "STOPPED")
    c.admin.ask("play")
    await c.stays_at_rest()


@pytest.mark.parametrize("how", ["fin", "rst"])
@pytest.mark.parametrize("ports", [None, ["rtde"]], ids=["every link", "rtde links"])
async def test_link_cut(strike: Strike, how: str, ports: list[str] | None) -> None:
    c, outcome = await strike(lambda c: c.admin.ask("drop", how=how, ports=ports))
    assert outcome.error.code == "link-lost"
    await until(lambda: c.admin.ask("state")["program"] is None)  # ur_rtde loads its program anew by itself
    await c.stays_at_rest(1.0)


async def test_a_lost_link_is_named_although_it_may_be_back_already(
    strike: Strike, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("station.devices.ur.POLL_S", 1.0)  # a computer that looks again only then
    c, outcome = await strike(lambda c: c.admin.ask("drop", how="rst"))
    assert outcome.error.code == "link-lost"
    await c.stays_at_rest()


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ({"cmd": "stall"}, "stale-state"),
        ({"cmd": "freeze"}, "stale-state"),
        ({"cmd": "black_hole"}, "stale-state"),
    ],
    ids=["silent link", "frozen data", "cable pulled"],
)
async def test_no_news(strike: Strike, fault: dict[str, Any], code: str) -> None:
    c, outcome = await strike(lambda c: c.admin.ask(**fault))
    assert isinstance(outcome.error, StaleStateError)
    assert outcome.error.code == code
    c.admin.ask(**fault, on=False)
    await c.stays_at_rest()


async def test_controller_restart(strike: Strike) -> None:
    c, _ = await strike(lambda c: c.admin.ask("restart", down_s=0.5, running=True))
    await until(lambda: c.robot.age_s() < 0.1)
    await c.stays_at_rest()


@pytest.mark.parametrize(
    ("kill", "code"),
    [(signal.SIGSEGV, "control-process"), (signal.SIGSTOP, "computer-late")],
    ids=["child segfault", "child held up"],
)
async def test_control_process(strike: Strike, kill: signal.Signals, code: str) -> None:
    killed: list[int] = []

    def strike_down(c: Any) -> None:
        killed[:] = [c.robot.control_pid]
        os.kill(killed[0], kill)

    c, outcome = await strike(strike_down)
    assert outcome.error.code == code
    await c.stays_at_rest()
    with pytest.raises(ProcessLookupError):
        os.kill(killed[0], 0)


async def test_a_control_process_held_up_between_two_moves_is_named_by_the_next(
    cell: Callable[..., Awaitable[Any]],
) -> None:
    c = await cell()
    control_pid, here = c.robot.control_pid, c.joints_rad()
    os.kill(control_pid, signal.SIGSTOP)
    await asyncio.sleep(0.4)
    with suppress(ProcessLookupError):  # the station may have ended it
        os.kill(control_pid, signal.SIGCONT)
    with pytest.raises(RobotError) as told:
        while True:
            await c.robot.move(here, 0.5, 1.0)
    assert told.value.code in set(Delay)  # on a busy computer the controller may be late, too


async def test_a_session_loop_that_stalls_stops_the_arm(strike: Strike) -> None:
    def stall(c: Any) -> None:
        c.beating = False

    c, outcome = await strike(stall)
    assert outcome.error.code == "computer-late"
    assert isinstance(outcome.error, RobotError)
    await c.stays_at_rest()


async def test_an_arm_that_goes_another_way_than_the_checked_one_is_stopped(
    cell: Callable[..., Awaitable[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    c = await cell()
    ask, before = ControlChild.move, c.joints_rad()

    async def elsewhere(self: ControlChild, joints_rad: list[float], *speeds: float) -> None:
        await ask(self, [joints_rad[0], joints_rad[1] - 0.6, *joints_rad[2:]], *speeds)

    monkeypatch.setattr(ControlChild, "move", elsewhere)
    with raises("off-path", joint=2):
        await c.far_move()
    await c.stops()
    assert max(abs(a - b) for a, b in zip(c.joints_rad(), before, strict=True)) < 0.5
    await c.stays_at_rest()
