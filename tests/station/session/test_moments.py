"""Odd moments of a run: what is asked of it while control starts, a way is checked, or it still writes."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest

from station.cell import limits
from station.cell.pose_plan import Plan
from station.cell.status import StationState as S
from station.cli.session import STOP_ANSWER_S
from station.protocol.verbs import Purpose, Skip
from station.session import run, session
from tests.codes import raises
from tests.patience import PATIENCE_S, until
from tests.station.session_rig import POSES, HeldDisk, Rig


class HeldStart:
    """Control is starting until `go_on` is set."""

    def __init__(self, rig: Rig) -> None:
        self.go_on = asyncio.Event()
        self._start = rig.arm.start_control
        rig.arm.start_control = self._held

    async def _held(self) -> None:
        await self._start()
        await self.go_on.wait()


@pytest.mark.parametrize("finishes", [False, True])
async def test_a_pose_skipped_while_control_starts_is_not_driven_and_a_finish_seals_without_a_move(
    rig: Rig, finishes: bool
) -> None:
    held = HeldStart(rig)
    await rig.give_go()
    await until(lambda: rig.arm.control)
    await (rig.session.finish(1) if finishes else rig.session.edit(1, Skip(1)))
    held.go_on.set()
    await rig.until(S.IDLE, S.FAULT)
    assert rig.state is S.IDLE, rig.session.store.status.reason
    if finishes:
        assert "move" not in rig.arm.log and rig.session.store.status.session.recording
    else:
        assert rig.pose_states == ["done", "skipped", *["done"] * (POSES - 2)]


async def test_a_lost_lease_before_anything_is_recorded_leaves_no_paused_session(
    rig: Rig, small_plan: Plan
) -> None:
    HeldStart(rig)
    await rig.give_go()
    await until(lambda: rig.arm.control)
    await rig.session.lease_lost(1)
    assert rig.state is S.IDLE and "stop" in rig.arm.log
    assert rig.cause == "control-lost"
    rig.session.take_lease(1, "anna")
    rig.session.load_plan(1, small_plan)  # neither finish nor resume would have had anything to do


async def test_finish_before_a_way_that_is_not_free_seals(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(geometry: Any, here: Any, there: Any, name: str) -> Any:
        rig.session.context.requests.finish = True  # a person asked while the way was looked at
        return limits._refused(name, [limits.Problem(name, "clearance", "forearm against table")])

    monkeypatch.setattr(run, "check_path", refused)
    await rig.go_until(S.IDLE, S.FAULT)
    assert rig.state is S.IDLE, rig.session.store.status.reason
    assert "move" not in rig.arm.log


class SlowCheck:
    """Looks at a way until `go_on` is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.go_on, self.looks = threading.Event(), threading.Event()
        self._check = run.check_path
        monkeypatch.setattr(run, "check_path", self)

    def __call__(self, *args: Any) -> Any:
        self.looks.set()
        assert self.go_on.wait(PATIENCE_S)
        return self._check(*args)


async def test_neither_heartbeat_nor_stop_waits_for_the_check_of_a_way(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = SlowCheck(monkeypatch)
    await rig.give_go()
    await until(slow.looks.is_set)
    before = rig.arm.beats
    await until(lambda: rig.arm.beats > before + 3)
    await rig.session.stop("bert")
    slow.go_on.set()
    await until(lambda: rig.arm.log[-1:] == ["end control"])
    assert rig.state is S.STOPPED and "move" not in rig.arm.log


async def test_an_arm_that_moved_while_its_way_was_checked_is_not_driven(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = SlowCheck(monkeypatch)
    await rig.give_go()
    await until(slow.looks.is_set)
    first, *rest = rig.arm.joints
    rig.arm.joints = (first + 0.02, *rest)
    logs: list[list[str]] = []

    def look() -> None:
        """The next pose's way begins where the arm is, and may be driven at once."""
        if rig.pose_states[0] == "failed":
            logs.append(list(rig.arm.log))

    rig.session.store.watch(look)
    slow.go_on.set()
    await until(lambda: bool(logs))
    failed = rig.session.store.status.session.poses[0]
    assert failed.cause == "arm-moved" and "1.1°" in failed.reason
    assert "move" not in logs[0]


async def test_a_run_that_cannot_be_made_leaves_the_station_at_rest(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary = await rig.session.prepare(1, Purpose.RUN)

    def broken(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(run, "cell_geometry", broken)
    with pytest.raises(ZeroDivisionError):
        await rig.session.go(1, summary.token)
    assert rig.state is S.IDLE and rig.session.approvals.waiting is None


async def test_nothing_new_begins_beside_a_run_that_does_not_end(
    rig: Rig, held_disk: HeldDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "END_RUN_S", 0.05)
    await rig.go_until(S.WRITING)
    await asyncio.wait_for(rig.session.stop("bert"), STOP_ANSWER_S)  # else `station capture` says: no answer
    assert "stop" in rig.arm.log
    await rig.session.acknowledge("anna")
    assert rig.state is S.PAUSED
    for what in (
        lambda: rig.session.switch_free_drive(1, True),
        lambda: rig.session.prepare(1, Purpose.RESUME),
        lambda: rig.session.finish(1),
    ):
        with raises("still-ending"):
            await what()
    assert rig.session.context.requests.halt
    held_disk.set()
    await until(lambda: rig.session._run is not None and rig.session._run.done())
    assert rig.arm.log.count("move") == 1 and "done" in rig.pose_states
