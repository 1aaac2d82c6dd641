"""An unattended simulated cell goes on after news that came late: three times, and after nothing else."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from station.cell.errors import RobotError, SafetyStopError, StaleStateError
from station.cell.status import StationState as S
from station.cli.session import Attended, attended
from station.devices.news import Delay
from station.protocol.verbs import Purpose
from station.server.connections import ClientServer
from station.server.dispatch import SessionDispatcher
from tests.codes import raises
from tests.station.session_rig import POSES, Rig, sealed

LATE = [StaleStateError(delay) for delay in Delay]
Call = Callable[..., Awaitable[Any]]


def first_fails(call: Call, errors: list[RobotError]) -> Call:
    """Its first calls end so."""
    left = list(errors)

    async def instead(*args: Any, **named: Any) -> Any:
        if left:
            raise left.pop(0)
        return await call(*args, **named)

    return instead


async def carried_out(rig: Rig, folder: Path, headless: bool = True) -> Attended:
    await rig.session.release(1)
    server = ClientServer(folder / "s", SessionDispatcher(rig.session))
    await server.start()
    rig.session.store.watch(server.publish)
    try:
        async with attended(folder / "s", headless, quiet=True) as shell:
            await shell.carry_out(Purpose.RUN)
    finally:
        await server.close()
    return shell


@pytest.mark.parametrize("count", [1, 3])
async def test_the_rest_is_approved_again(rig: Rig, tmp_path: Path, count: int) -> None:
    rig.arm.move = first_fails(rig.arm.move, LATE[:count])
    shell = await carried_out(rig, tmp_path)
    assert rig.state is S.IDLE and rig.session.store.status.session.captured == POSES
    assert shell.approved_again == count == len(rig.told("acknowledged"))
    kept = [event.detail for event in sealed(rig).events()]
    assert len([text for text in kept if "approved by" in text]) == count + 1


async def test_so_it_is_where_they_were_late_before_anything_moved(rig: Rig, tmp_path: Path) -> None:
    """At the start of control, of a new session and of one begun, and at the check before it."""
    rig.arm.start_control = first_fails(rig.arm.start_control, LATE[:1])
    assert (await carried_out(rig, tmp_path)).approved_again == 1
    assert rig.state is S.IDLE and rig.session.store.status.session.captured == POSES

    async def late_from_then_on(*_: Any) -> None:
        rig.arm.move = move
        rig.arm.start_control = first_fails(rig.arm.start_control, LATE[:1])
        rig.arm.may_start = first_fails(rig.arm.may_start, LATE[:1])
        raise LATE[0]

    rig.arm.move, move = late_from_then_on, rig.arm.move
    assert (await carried_out(rig, tmp_path)).approved_again == 3
    assert rig.state is S.IDLE and rig.session.store.status.session.captured == POSES


async def test_the_fourth_lateness_waits_for_a_person(rig: Rig, tmp_path: Path) -> None:
    rig.arm.move = first_fails(rig.arm.move, [*LATE, *LATE])
    await carried_out(rig, tmp_path)
    assert rig.state is S.FAULT and rig.cause == Delay.COMPUTER


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (StaleStateError(), S.FAULT),
        (RobotError("program-ended"), S.FAULT),
        (SafetyStopError("protective-stop"), S.STOPPED),
    ],
)
async def test_nothing_but_lateness_is_gone_on_after(
    rig: Rig, tmp_path: Path, error: RobotError, state: S
) -> None:
    rig.arm.move = first_fails(rig.arm.move, [error])
    shell = await carried_out(rig, tmp_path)
    assert rig.state is state and shell.approved_again == 0


async def test_a_persons_stop_is_not_acknowledged(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even the one that comes just before the acknowledgement."""
    rig.arm.move = first_fails(rig.arm.move, LATE[:1])
    acknowledge = rig.session.acknowledge

    async def stopped_just_before(*asked: Any) -> None:
        await rig.session.stop("ben")
        await acknowledge(*asked)

    monkeypatch.setattr(rig.session, "acknowledge", stopped_just_before)
    with raises("stopped-again"):
        await carried_out(rig, tmp_path)
    assert rig.state is S.STOPPED and not rig.told("acknowledged")


async def test_where_a_person_may_attend_they_go_on(rig: Rig, tmp_path: Path) -> None:
    rig.arm.move = first_fails(rig.arm.move, LATE[:1])
    await carried_out(rig, tmp_path, headless=False)
    assert rig.state is S.FAULT


async def test_a_real_cell_waits_for_a_person(rig: Rig, tmp_path: Path) -> None:
    shell = Attended(tmp_path, None, simulated=False, headless=True, approved="", quiet=True)
    assert not shell._goes_on(Delay.COMPUTER)
