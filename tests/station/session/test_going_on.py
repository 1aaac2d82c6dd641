"""A simulated cell goes on by itself after news that came late: three times, and after nothing else."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from station.cell.errors import RobotError, SafetyStopError, StaleStateError
from station.cell.status import StationState as S
from station.devices.news import Delay
from tests.patience import until
from tests.station.session_rig import POSES, NewRig, Rig, sealed

LATE = [StaleStateError(delay) for delay in Delay]


async def end_of_run(rig: Rig, errors: list[RobotError]) -> Rig:
    """A run whose first moves end so, at its rest; of a cell whose simulator the station started."""
    context = rig.session.context
    context.cell = replace(context.cell, own_simulator=context.cell.simulated)
    return await end_of_any_run(rig, errors)


async def end_of_any_run(rig: Rig, errors: list[RobotError]) -> Rig:
    move, left = rig.arm.move, list(errors)

    async def fails_first(*request: Any) -> None:
        if left:
            rig.arm.log.append("move")
            rig.arm.joints = tuple(joint + 0.01 for joint in rig.arm.joints)  # it was on its way
            raise left.pop(0)
        await move(*request)

    rig.arm.move = fails_first
    await rig.go_until(S.IDLE, S.PAUSED, S.FAULT, S.STOPPED)
    return rig


@pytest.mark.parametrize("count", [1, 3])
async def test_a_simulated_cell_goes_on_after_lateness_and_says_how_often(rig: Rig, count: int) -> None:
    await end_of_run(rig, LATE[:count])
    session = rig.session.store.status.session
    assert rig.state is S.IDLE and session.captured == POSES
    assert session.approved_again == count
    assert S.FAULT not in rig.states and S.PAUSED not in rig.states
    kept = [event.detail for event in sealed(rig).events()]
    assert len([text for text in kept if "by this simulated cell itself" in text]) == count
    told = [event.code for event in rig.session.store.status.events if event.code in set(Delay)]
    assert told == list(Delay)[:count]


async def test_the_fourth_lateness_waits_for_a_person(rig: Rig) -> None:
    await end_of_run(rig, [*LATE, LATE[0], LATE[0]])
    assert rig.state is S.FAULT and rig.cause == Delay.COMPUTER
    assert rig.session.store.status.session.approved_again == 3
    assert rig.arm.log.count("move") == 4


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (StaleStateError(), S.FAULT),
        (RobotError("program-ended"), S.FAULT),
        (SafetyStopError("protective-stop"), S.STOPPED),
    ],
)
async def test_nothing_but_lateness_is_gone_on_after(rig: Rig, error: RobotError, state: S) -> None:
    await end_of_run(rig, [error])
    assert rig.state is state and rig.arm.log.count("move") == 1


@pytest.mark.parametrize("source", ["real", "playback", "simulated"])
async def test_any_other_cell_waits_for_a_person(new_rig: NewRig, source: str) -> None:
    """A simulated one, too, whose simulator is somebody else's."""
    rig = await end_of_any_run(await new_rig(source=source), LATE[:1])
    assert rig.state is S.FAULT and rig.cause == Delay.COMPUTER and rig.arm.log.count("move") == 1


@pytest.mark.parametrize("how", ["stop", "lost"])
async def test_stop_and_a_lost_client_end_it_while_it_approves_again(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    async def ended_meanwhile(*_: Any) -> None:
        await (rig.session.stop("ben") if how == "stop" else rig.session.lease_lost(1))

    summary = await rig.session.prepare(1, "run")
    monkeypatch.setattr("station.session.run.offered", ended_meanwhile)
    monkeypatch.setattr(rig.arm, "move", _late)
    context = rig.session.context
    context.cell = replace(context.cell, own_simulator=True)
    await rig.session.go(1, summary.token)
    await rig.until(S.STOPPED, S.PAUSED)
    assert rig.state is (S.STOPPED if how == "stop" else S.PAUSED)
    assert rig.session.store.status.session.approved_again == 0


async def _late(*_: Any) -> None:
    raise LATE[0]


async def test_news_of_a_resting_arm_that_came_late_are_told_with_what_made_them_late(rig: Rig) -> None:
    rig.arm.late, rig.arm.gap_s = True, 0.8
    supervisor = rig.session.supervisor
    await until(lambda: supervisor._late_since_s)
    supervisor._late_since_s -= 0.5
    rig.arm.late = False
    await until(lambda: rig.told(Delay.CONTROLLER))
    assert rig.state is S.IDLE
