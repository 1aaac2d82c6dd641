"""What holds the latch, what it bars, and that a restart of the daemon does not end it."""

from __future__ import annotations

import asyncio
import errno
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from station.cell.errors import RefusedError, RobotError, SafetyStopError
from station.cell.status import StationState as S
from station.session import latch
from station.session.latch import LatchKeeper
from tests.codes import raises
from tests.patience import until
from tests.station.session_rig import NewRig, Rig, crash


async def stop(rig: Rig) -> None:
    await rig.session.stop("bert")


async def fault(rig: Rig) -> None:
    rig.arm.refuse_control = None
    rig.arm.trouble = None
    await rig.go_until_it_moves()
    rig.arm.trouble = RobotError("program-ended", state="stopped", by="", runtime_state=1)
    rig.arm.arrive.set()
    await rig.until(S.FAULT)
    rig.arm.trouble = None


async def safety_stop(rig: Rig) -> None:
    await rig.go_until_it_moves()
    rig.arm.trouble = SafetyStopError("protective-stop", mode="PROTECTIVE STOP")
    rig.arm.arrive.set()
    await rig.until(S.STOPPED)
    rig.arm.trouble = None


async def safety_stop_at_rest(rig: Rig) -> None:
    rig.arm.trouble = SafetyStopError("protective-stop", mode="PROTECTIVE STOP")
    await until(lambda: rig.session.latch.held is not None)
    rig.arm.trouble = None


async def lost_connection(rig: Rig) -> None:
    await rig.go_until_it_moves()
    await rig.session.lease_lost(1)


HOLDERS: list[tuple[Callable[..., object], S | None]] = [
    (stop, S.STOPPED),
    (fault, S.FAULT),
    (safety_stop, S.STOPPED),
    (safety_stop_at_rest, None),
    (lost_connection, None),
]


@pytest.mark.parametrize(("happens", "latched"), HOLDERS)
@pytest.mark.parametrize("end", ["orderly", "killed"])
async def test_what_was_latched_is_latched_for_the_next_daemon_until_a_person_acknowledges(
    new_rig: NewRig, happens: Callable[..., object], latched: S | None, end: str
) -> None:
    rig = await new_rig(source="real")
    await happens(rig)  # type: ignore[misc]
    reason, cause = rig.session.latch.held.reason, rig.session.latch.held.cause
    assert rig.session.latch.held.state == latched
    await rig.session.latch.settled(60)
    recorded = rig.session.context.recording is not None
    if end == "killed" and recorded:
        crash(rig)
    elif end == "orderly":
        await rig.session.close()
    second = await new_rig(source="real", with_plan=False)
    session = second.session
    assert session.latch.bars_services and session.store.status.services_barred
    if recorded and end == "killed":  # whatever held it, the session is interrupted, too
        assert second.state is S.STOPPED and second.cause == "interrupted"
    elif latched is None:
        assert second.state not in (S.STOPPED, S.FAULT) and second.told("services-barred")
    else:
        assert (second.state, second.cause) == (latched, cause)
    assert reason in " ".join(event.text for event in session.store.status.events)
    await session.acknowledge("anna")
    assert second.state not in (S.STOPPED, S.FAULT)
    assert not session.latch.bars_services and not session.store.status.services_barred
    if session.context.recording is None:  # an unfinished session is interrupted by every end
        await session.close()
        third = await new_rig(source="real", with_plan=False)
        assert third.session.latch.held is None and third.state is not S.STOPPED


async def test_stop_goes_out_before_its_latch_is_written(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does it wait for a disk that hangs."""
    stopped_first: list[bool] = []
    hangs = asyncio.Event()
    loop = asyncio.get_running_loop()

    def write(path: Path, content: bytes) -> None:
        stopped_first.append("stop" in rig.arm.log)
        asyncio.run_coroutine_threadsafe(hangs.wait(), loop).result()

    monkeypatch.setattr(latch, "write_atomically", write)
    await rig.go_until_it_moves()
    await rig.session.stop("bert")
    await until(lambda: bool(stopped_first))
    assert stopped_first == [True] and rig.state is S.STOPPED
    hangs.set()
    await rig.session.latch.settled(60)


async def test_a_latch_that_cannot_be_written_is_tried_again(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    write, tries = latch.write_atomically, []

    def full(path: Path, content: bytes) -> None:
        tries.append(path)
        if len(tries) < 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, content)

    monkeypatch.setattr(latch, "RETRY_S", 0.0)
    monkeypatch.setattr(latch, "write_atomically", full)
    await rig.session.stop("bert")
    await rig.session.latch.settled(60)
    assert len(tries) == 3
    assert json.loads(tries[0].read_text())["cause"] == "stop"


@pytest.mark.parametrize("content", [b"", b"\x00" * 200, b'{"state":"stopp', b'{"reason":1}', b"[]"])
async def test_a_latch_that_cannot_be_read_counts_as_stop(
    new_rig: NewRig, tmp_path: Path, content: bytes
) -> None:
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "latch-real.json").write_bytes(content)
    rig = await new_rig(source="real", with_plan=False)
    assert (rig.state, rig.cause) == (S.STOPPED, "latch-unreadable")
    await rig.until(S.STOPPED)
    await rig.session.acknowledge("anna")
    assert rig.state is not S.STOPPED and not list((tmp_path / "root").glob("latch*"))


async def test_a_simulated_cell_neither_sees_nor_ends_the_latch_of_a_real_arm(new_rig: NewRig) -> None:
    real = await new_rig(source="real")
    await real.session.stop("bert")
    await real.session.close()
    simulated = await new_rig()
    assert simulated.session.latch.held is None
    await simulated.session.stop("bert")
    await simulated.session.acknowledge("a program")
    await simulated.session.close()
    again = await new_rig(source="real", with_plan=False)
    assert (again.state, again.cause) == (S.STOPPED, "stop")


async def test_an_arm_that_a_person_moves_does_not_free_the_latch_of_one_that_the_station_moves(
    new_rig: NewRig, tmp_path: Path
) -> None:
    """Both are real and may use one folder, one after the other."""
    real = await new_rig(source="real")
    await real.session.stop("bert")
    await real.session.close()
    keeper = LatchKeeper(tmp_path / "root", "real", moved=False, told=lambda latch: None)
    keeper.begin_with(keeper.read())
    assert keeper.needs_person
    keeper.hold("STOP", "stop", S.STOPPED)
    assert keeper.held is not None and keeper.held.needs_person


async def test_a_person_who_approves_after_a_lost_connection_has_looked(new_rig: NewRig) -> None:
    rig = await new_rig(source="real")
    await lost_connection(rig)
    rig.session.take_lease(2, "anna")
    rig.arm.slow = False
    offer = await rig.session.prepare(2)
    await rig.session.go(2, offer.token, by_person=True)
    assert not rig.session.latch.bars_services


async def test_an_approval_does_not_end_a_stop(rig: Rig) -> None:
    await rig.session.stop("bert")
    rig.session.latch.release_bar()
    assert rig.session.latch.held is not None


async def test_nothing_is_acknowledged_where_nothing_is_latched(rig: Rig) -> None:
    with raises("wrong-state"):
        await rig.session.acknowledge("anna")
    assert not rig.told("acknowledged")


async def test_after_a_lost_connection_an_acknowledgement_lets_services_approve_again(rig: Rig) -> None:
    await lost_connection(rig)
    resting = rig.state
    assert resting in (S.IDLE, S.PAUSED)
    await rig.session.acknowledge("anna")
    assert rig.state is resting and rig.session.latch.held is None
    with pytest.raises(RefusedError):
        await rig.session.acknowledge("anna")
