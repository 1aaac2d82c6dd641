"""How pictures, runs and helpers end when several things happen at once."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from typing import Any

import pytest

from station.analysis.estimation import running_estimate
from station.analysis.pool import WorkerError, Workers
from station.analysis.worker import start_worker
from station.cell.pose_plan import PlannedPose
from station.cell.session_folder import SessionState
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose
from station.session import session
from station.session.recording import SessionRecording
from tests.codes import raises
from tests.patience import PATIENCE_S, until
from tests.station.session_rig import POSES, TRUTH, HeldDisk, Rig


@pytest.fixture
async def guided(bare_rig: Rig) -> Rig:
    """In free drive, at a place where no picture was taken yet."""
    bare_rig.arm.rest()
    await bare_rig.session.switch_free_drive(1, True)
    return bare_rig


@pytest.mark.parametrize(
    ("by", "state", "poses"),
    [("finish", S.IDLE, ["done"]), ("pause", S.PAUSED, ["done"]), ("stop", S.STOPPED, ["planned"])],
)
async def test_what_ends_freedrive_waits_for_its_image_unless_it_is_stop(
    guided: Rig, held_camera: asyncio.Event, by: str, state: S, poses: list[str]
) -> None:
    taking = asyncio.ensure_future(guided.session.record(1))
    await guided.until(S.CAPTURING)
    ending: asyncio.Future[None] | None = None
    if by == "finish":
        ending = asyncio.ensure_future(guided.session.finish(1))
        await asyncio.sleep(0.02)
        assert not ending.done()
    elif by == "pause":
        guided.session.pause("bert")
    else:
        await guided.session.stop("bert")
    held_camera.set()
    await taking
    if ending is not None:
        await ending
    assert guided.state is state and guided.pose_states == poses
    assert bool(guided.session.store.status.session.recording) == (by == "finish")
    assert not guided.arm.guided, "its news may be late as those of an arm at rest"
    if by != "finish":
        if by == "stop":
            await guided.session.acknowledge("anna")
        await guided.session.switch_free_drive(1, True)
        await guided.session.record(1)
        assert guided.state is S.FREE_DRIVE and guided.arm.guided, "what was asked before is done"


async def test_a_disk_that_fails_after_stop_is_told_and_stop_stays_latched(
    rig: Rig, held_disk: HeldDisk
) -> None:
    held_disk.fails = True
    await rig.go_until(S.WRITING)
    stopping = asyncio.ensure_future(rig.session.stop("bert"))
    await rig.until(S.STOPPED)
    held_disk.set()
    await stopping
    assert rig.state is S.STOPPED
    assert "STOP by bert" in rig.session.store.status.reason
    assert [event.level for event in rig.told("recording")] == ["info", "error"]
    assert rig.session.context.require_recording().recorder is None
    assert "done" not in rig.pose_states


async def test_a_picture_being_written_outlives_every_halt(rig: Rig, held_disk: HeldDisk) -> None:
    await rig.go_until(S.WRITING)
    run = rig.session._run
    for _ in range(3):
        run.cancel()
        await asyncio.sleep(0.01)
    assert not run.done()
    held_disk.set()
    await asyncio.wait({run})
    assert rig.pose_states[0] == "done"


async def test_of_two_states_of_a_session_the_newer_one_stays_on_the_disk(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    await rig.go_until_it_moves()
    recording, queue = rig.session.context.require_recording(), rig.session.context.loaded()
    disk, begun, written = threading.Event(), [], []

    def slow(self: SessionRecording, state: SessionState) -> None:
        begun.append(1)
        if len(begun) == 1:
            disk.wait(PATIENCE_S)
        written.append(len(state.poses))

    monkeypatch.setattr(SessionRecording, "_write_state", slow)
    older = asyncio.create_task(recording.save_state(queue))
    await asyncio.sleep(0.01)
    older.cancel()  # as STOP does
    queue.add(PlannedPose("hand", TRUTH.start_joints_rad))
    newer = asyncio.create_task(recording.save_state(queue))
    await asyncio.sleep(0.05)
    disk.set()
    await asyncio.wait({older, newer})
    assert written == [POSES, POSES + 1]


class HeldSeal(asyncio.Event):
    """A recording that is not sealed before this is set; `begun` counts."""

    begun = 0


@pytest.fixture
def held_seal(monkeypatch: pytest.MonkeyPatch) -> HeldSeal:
    held, seal = HeldSeal(), SessionRecording.seal

    async def slow(recording: SessionRecording, queue: Any) -> Any:
        held.begun += 1
        await held.wait()
        return await seal(recording, queue)

    monkeypatch.setattr(SessionRecording, "seal", slow)
    return held


@pytest.mark.parametrize("by", ["the run's end", "finish"])
async def test_nothing_begins_beside_a_sealing_that_stop_came_into(
    rig: Rig, held_seal: HeldSeal, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    monkeypatch.setattr(session, "END_RUN_S", 0.05)
    monkeypatch.setattr(session, "STOP_WAIT_S", 0.05)
    finishing: asyncio.Future[None] | None = None
    if by == "finish":
        await rig.go_until_it_moves()
        await rig.pause_after_this_pose("anna")
        finishing = asyncio.ensure_future(rig.session.finish(1))
        await rig.until(S.SEALING)
    else:
        await rig.go_until(S.SEALING)
    for _ in range(2):
        await rig.session.stop("bert")
        await rig.session.acknowledge("anna")
        with raises("still-ending"):
            await rig.session.prepare(1, Purpose.RESUME)
        with raises("still-ending"):
            await rig.session.finish(1)
    moves = rig.arm.log.count("move")
    held_seal.set()
    await rig.until(S.IDLE)
    if finishing is not None:
        await finishing
    assert held_seal.begun == 1 and rig.session.store.status.session.recording
    assert rig.arm.log.count("move") == moves


async def test_a_defect_in_the_estimate_costs_one_estimate(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    call, asked = rig.worker.call, []

    async def broken(function: Any, *args: Any, **named: Any) -> Any:
        if function is running_estimate:
            asked.append(1)
            raise IndexError("a defect")
        return await call(function, *args, **named)

    monkeypatch.setattr(rig.worker, "call", broken)
    await rig.go_until(S.IDLE)
    await until(lambda: len(asked) > 1)
    assert rig.pose_states == ["done"] * POSES


async def test_a_call_that_hangs_costs_its_own_answer_only_and_nobody_waits_for_its_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    workers = Workers(start_worker)
    await workers.start()
    ended, waited = threading.Event(), list[bool]()
    for process in workers._pool._processes.values():  # ones that take their time to end
        monkeypatch.setattr(process, "join", lambda *_: waited.append(ended.wait(PATIENCE_S)))
    slow = asyncio.ensure_future(workers.call(time.sleep, 0.6))
    hanging = asyncio.ensure_future(workers.call(time.sleep, PATIENCE_S, timeout_s=0.5))
    # Neither the calls before it nor the worker that starts anew count as its own time.
    behind = asyncio.ensure_future(workers.call(time.sleep, 0.0, timeout_s=0.5))
    results = await asyncio.gather(slow, hanging, behind, return_exceptions=True)
    assert results[0] is None and results[2] is None and not waited
    assert isinstance(results[1], WorkerError) and results[1].code == "worker-late"
    ended.set()
    given_up = asyncio.ensure_future(workers.call(time.sleep, PATIENCE_S))
    await asyncio.sleep(0.05)
    given_up.cancel()
    assert await workers.call(time.sleep, 0.0, timeout_s=0.5) is None, "nobody waits for what nobody wants"
    # At the station's end a call that waits starts no worker.
    calls = [asyncio.ensure_future(workers.call(time.sleep, s)) for s in (PATIENCE_S, 0.0)]
    await asyncio.sleep(0.05)
    workers.close()
    results = await asyncio.gather(*calls, return_exceptions=True)
    assert [type(result) for result in results] == [WorkerError] * 2 and workers._pool is None


async def test_a_worker_that_freezes_before_it_reads_an_image_leaves_no_thread() -> None:
    workers, before = Workers(start_worker), threading.active_count()
    os.kill(await workers.call(os.getpid), signal.SIGSTOP)
    with raises("worker-late"):
        await workers.call(len, bytes(2**20), timeout_s=0.2)
    await until(lambda: threading.active_count() <= before)


async def test_nothing_begins_once_the_daemon_ends(rig: Rig) -> None:
    offer = await rig.session.prepare(1)
    closing = asyncio.create_task(rig.session.close())
    await asyncio.sleep(0)
    with raises("station-ending"):
        await rig.session.go(1, offer.token)
    with raises("station-ending"):
        await rig.session.prepare(1)
    await closing
    assert "move" not in rig.arm.log
