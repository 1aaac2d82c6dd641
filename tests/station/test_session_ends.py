"""How pictures, runs and helpers end when several things happen at once."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from station.errors import RobotError
from station.estimation import running_estimate
from station.session.recording import SessionRecording
from station.status import StationState as S
from station.workers import WorkerError, Workers
from tests.station.session_rig import POSES, HeldDisk, Rig


@pytest.fixture
async def guided(bare_rig: Rig) -> Rig:
    """In free drive, at a place where no picture was taken yet."""
    bare_rig.arm.rest()
    await bare_rig.session.switch_free_drive(1, True, auto=False)
    return bare_rig


@asynccontextmanager
async def picture_under_way(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[None]:
    """A hand-guided picture that comes at the end of the block."""
    comes, capture = asyncio.Event(), rig.camera.capture

    async def slow(timeout_s: float = 5.0) -> Any:
        await comes.wait()
        return await capture(timeout_s)

    monkeypatch.setattr(rig.camera, "capture", slow)
    taking = asyncio.ensure_future(rig.session.record(1))
    await rig.until(S.CAPTURING)
    yield
    comes.set()
    await taking


async def test_finish_during_a_hand_guided_picture_takes_it_and_seals(
    guided: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with picture_under_way(guided, monkeypatch):
        finishing = asyncio.ensure_future(guided.session.finish(1))
        await asyncio.sleep(0.02)
        assert not finishing.done()
    await finishing
    assert guided.state is S.IDLE and guided.pose_states == ["done"]
    assert guided.session.store.status.session.recording


async def test_pause_during_a_hand_guided_picture_ends_free_drive(
    guided: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with picture_under_way(guided, monkeypatch):
        guided.session.pause("bert")
    assert guided.state is S.PAUSED and guided.pose_states == ["done"]


async def test_free_drive_switched_on_twice_watches_once(guided: Rig) -> None:
    def watchers() -> int:
        return sum("FreeDrive._watch" in str(task.get_coro()) for task in asyncio.all_tasks())

    for _ in range(3):
        await guided.session.switch_free_drive(1, True, auto=True)
    await asyncio.sleep(0)
    assert watchers() == 1
    await guided.session.switch_free_drive(1, True, auto=False)
    await asyncio.sleep(0)
    assert watchers() == 0


async def test_control_has_ended_before_the_recording_is_sealed(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    seal = SessionRecording.seal

    async def noted(self: SessionRecording, queue: Any) -> Any:
        rig.arm.log.append("seal")
        return await seal(self, queue)

    monkeypatch.setattr(SessionRecording, "seal", noted)
    await rig.give_go()
    await rig.until(S.IDLE)
    assert rig.arm.log.index("end control") < rig.arm.log.index("seal")


async def test_a_disk_that_fails_after_stop_is_told_and_stop_stays_latched(
    rig: Rig, held_disk: HeldDisk
) -> None:
    held_disk.fails = True
    await rig.give_go()
    await rig.until(S.WRITING)
    stopping = asyncio.ensure_future(rig.session.stop("bert"))
    await rig.until(S.STOPPED)
    held_disk.set()
    await stopping
    assert rig.state is S.STOPPED
    assert "STOP by bert" in rig.session.store.status.reason
    assert "no space left" in rig.session.store.status.reason
    assert any("no space left" in e.text and e.level == "error" for e in rig.session.store.status.events)
    assert rig.session.bench.require_recording().recorder is None
    assert "done" not in rig.pose_states


async def test_a_picture_being_written_outlives_every_halt(rig: Rig, held_disk: HeldDisk) -> None:
    await rig.give_go()
    await rig.until(S.WRITING)
    run = rig.session._run
    assert run is not None
    for _ in range(3):
        run.cancel()
        await asyncio.sleep(0.01)
    assert not run.done()
    held_disk.set()
    await asyncio.wait({run})
    assert rig.pose_states[0] == "done"


async def test_a_fault_between_moves_stops_the_arm_by_both_ways(rig: Rig, held_disk: HeldDisk) -> None:
    await rig.give_go()
    await rig.until(S.WRITING)
    rig.arm.trouble = RobotError("the program was stopped")
    held_disk.set()
    await rig.until(S.FAULT)
    await rig.until_true(lambda: "end control" in rig.arm.log)
    assert "stop" in rig.arm.log


async def test_a_defect_in_the_estimate_costs_one_estimate(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    call, asked = rig.worker.call, []

    async def broken(function: Any, *args: Any, timeout_s: float = 60.0) -> Any:
        if function is running_estimate:
            asked.append(1)
            raise IndexError("a defect")
        return await call(function, *args, timeout_s=timeout_s)

    monkeypatch.setattr(rig.worker, "call", broken)
    await rig.give_go()
    await rig.until(S.IDLE)
    await rig.until_true(lambda: len(asked) > 1)
    assert rig.pose_states == ["done"] * POSES


def _hang(seconds: float) -> None:
    time.sleep(seconds)


async def test_a_worker_that_hangs_is_ended_without_holding_up_the_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    workers = Workers()
    await workers.call(_hang, 0.0)
    assert workers._pool is not None
    for process in workers._pool._processes.values():
        monkeypatch.setattr(process, "join", _hang)  # a process that takes its time to end
    begun_s = time.monotonic()
    with pytest.raises(WorkerError):
        await workers.call(_hang, 30.0, timeout_s=0.1)
    assert time.monotonic() - begun_s < 0.6
    workers.close()
