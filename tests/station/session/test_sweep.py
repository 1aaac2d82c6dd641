"""A sweep obeys every rule of a session, and its pictures are on the disk."""

from __future__ import annotations

import asyncio
import dataclasses
import threading
from collections.abc import Callable

import numpy as np
import pytest

from recordings.reader import Recording
from recordings.schema.messages import Image
from station.analysis.worker import BoardDetection
from station.cell.errors import CameraError
from station.cell.status import DetectionStatus
from station.cell.status import StationState as S
from station.plan.files import SWINGS, sweep_plan
from station.protocol.verbs import Drop, Purpose, Skip
from tests.codes import raises
from tests.station.session_rig import TRUTH, CameraInMemory, Rig, sealed


@pytest.fixture
async def sweeping(rig: Rig) -> Rig:
    rig.session.load_plan(1, sweep_plan("UR10", "eye-in-hand", TRUTH.start_joints_rad))
    return rig


async def swing_to_the_end(rig: Rig) -> None:
    """At least three pictures a swing of the slow arm."""
    for number in range(SWINGS):
        await rig.until_true(lambda n=number: rig.arm.log.count("move") == n + 1)
        before = rig.camera.taken
        await rig.until_true(lambda before=before: rig.camera.taken > before + 2)
        rig.arm.arrive.set()
    await rig.until(S.IDLE)


async def test_it_swings_takes_pictures_and_comes_back(sweeping: Rig) -> None:
    sweeping.arm.slow = True
    summary = await sweeping.session.prepare(1, Purpose.RUN)
    assert "sweep: 8 slow swings" in summary.purpose and sweeping.arm.log == []
    sweeping.session.go(1, summary.token)
    await sweeping.until(S.MOVING)
    assert sweeping.session.context.require_recording().elapsed_s > 0
    await swing_to_the_end(sweeping)
    assert sweeping.arm.joints == pytest.approx(TRUTH.start_joints_rad)
    assert sweeping.pose_states == ["done"] * SWINGS
    recording: Recording = sealed(sweeping)
    assert len(recording.segments[0].image_sequences()) > 2 * SWINGS
    assert list(recording.views()) == []


async def test_stop_ends_swing_and_pictures(sweeping: Rig) -> None:
    sweeping.arm.slow = True
    await sweeping.give_go()
    await sweeping.until_true(lambda: sweeping.camera.taken > 3 and sweeping.arm.under_way)
    await sweeping.session.stop("anna")
    taken = sweeping.camera.taken
    assert sweeping.session.store.state is S.STOPPED and "stop" in sweeping.arm.log
    await asyncio.sleep(0.1)
    assert sweeping.camera.taken == taken and sweeping.arm.log.count("move") == 1
    sweeping.session.acknowledge("anna")
    assert sweeping.session.store.state is S.PAUSED
    with raises("approval-used"):
        sweeping.session.go(1, "the old one")


async def test_without_the_board_in_view_nothing_moves(sweeping: Rig) -> None:
    sweeping.worker.sees = BoardDetection(DetectionStatus(reason="too dark"), np.arange(0), np.zeros((0, 2)))
    await sweeping.give_go()
    await sweeping.until(S.IDLE)
    assert sweeping.cause == "no-board"
    assert "move" not in sweeping.arm.log and sweeping.session.context.recording is None


async def test_a_camera_that_fails_again_and_again_ends_it_after_the_swing(sweeping: Rig) -> None:
    sweeping.arm.slow = True
    await sweeping.give_go()
    await sweeping.until_true(lambda: sweeping.camera.taken > 3)
    sweeping.camera.fail = ["no picture"] * 5
    await sweeping.until_true(lambda: len(sweeping.camera.fail) == 2)
    sweeping.arm.arrive.set()
    await sweeping.until(S.PAUSED)
    assert sweeping.arm.log.count("move") == 1


async def test_a_full_disk_stops_the_arm_at_once(sweeping: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    sweeping.arm.slow = True
    await stops_on_a_full_disk(sweeping, monkeypatch)


async def stops_on_a_full_disk(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    await rig.give_go()
    await rig.until_true(lambda: rig.camera.taken > 3)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("recordings.mcap.output.OutputFile.write", full)
    await rig.until(S.FAULT)
    assert "No space left" in rig.session.store.status.reason
    await rig.until_true(lambda: "stop" in rig.arm.log)


class StreamingInMemory(CameraInMemory):
    """Sends frames from a thread of its own, at its own pace."""

    free_running = True

    def __init__(self) -> None:
        super().__init__()
        self.streams = 0

    async def stream(self, callback: Callable[[Image], None], stop: threading.Event) -> None:
        self.streams += 1
        await asyncio.to_thread(self._send, callback, stop)

    def _send(self, callback: Callable[[Image], None], stop: threading.Event) -> None:
        while not stop.is_set():
            if self.fail:
                raise CameraError(self.fail.pop(0))
            callback(asyncio.run(self.capture()))
            stop.wait(0.02)  # 65 MB/s: however busy the disk is, none may be dropped
        callback(asyncio.run(self.capture()))  # one that was on its way


@pytest.fixture
async def streaming(rig: Rig) -> Rig:
    rig.camera = StreamingInMemory()
    cell = dataclasses.replace(rig.session.context.cell, camera=rig.camera)
    rig.session.context.cell = cell
    rig.arm.slow = True
    rig.session.load_plan(1, sweep_plan("UR10", "eye-in-hand", TRUTH.start_joints_rad))
    return rig


async def test_every_frame_of_a_streaming_camera_is_recorded(streaming: Rig) -> None:
    await streaming.give_go()
    await swing_to_the_end(streaming)
    assert streaming.camera.streams == 1
    part = sealed(streaming).segments[0]
    ids = [facts.frame_id for facts in part.image_facts()]
    assert ids == list(range(2, 2 + len(ids))), "all that follow the first look at the board"
    assert len(ids) == streaming.camera.taken - 2 > 2 * SWINGS, "but for that look and the one that came late"


async def test_stop_ends_a_stream(streaming: Rig) -> None:
    await streaming.give_go()
    await streaming.until_true(lambda: streaming.camera.taken > 3)
    await streaming.session.stop("anna")
    taken = streaming.camera.taken
    assert streaming.session.store.state is S.STOPPED
    await asyncio.sleep(0.1)
    assert streaming.camera.taken <= taken + 1 and streaming.arm.log.count("move") == 1


async def test_a_stream_that_breaks_is_begun_again_and_given_up_in_the_end(streaming: Rig) -> None:
    await streaming.give_go()
    await streaming.until_true(lambda: streaming.camera.taken > 3)
    streaming.camera.fail = ["gone"]
    before = streaming.camera.taken
    await streaming.until_true(lambda: streaming.camera.taken > before + 3)
    assert streaming.camera.streams == 2
    streaming.camera.fail = ["gone"] * 3
    await streaming.until_true(lambda: not streaming.camera.fail)
    streaming.arm.arrive.set()
    await streaming.until(S.PAUSED)
    assert streaming.arm.log.count("move") == 1


async def test_a_full_disk_stops_a_stream_and_the_arm(
    streaming: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    await stops_on_a_full_disk(streaming, monkeypatch)


async def test_a_swing_that_a_person_leaves_out_or_drops_is_not_driven(sweeping: Rig) -> None:
    rig = sweeping
    await rig.go_until_it_moves()
    await rig.session.edit(Skip, 1, lambda queue: queue.skip(1))
    for index in range(2, SWINGS - 1):
        await rig.session.edit(Drop, 1, lambda queue, index=index: queue.drop(index))
    for number in (1, 2):
        await rig.until_true(lambda n=number: rig.arm.log.count("move") == n)
        rig.arm.arrive.set()
    await rig.until(S.IDLE, S.FAULT)
    assert rig.state is S.IDLE, rig.session.store.status.reason
    assert rig.arm.log.count("move") == 2
    assert rig.pose_states == ["done", "skipped", "done"]
