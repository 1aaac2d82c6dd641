"""The recorder: acknowledged means on the disk, memory is bounded, the first error is the last."""

from __future__ import annotations

import asyncio
import errno
import os
import threading
from pathlib import Path

import numpy as np
import pytest

from recordings import recorder as recorder_module
from recordings import writer as writer_module
from recordings.mcap.output import OutputFile
from recordings.reader import open_recording
from recordings.recorder import Recorder
from recordings.schema.definitions import encode
from recordings.schema.messages import CaptureEvent, Stamps
from recordings.writer import RecordingWriter
from tests.durability import full
from tests.patience import PATIENCE_S, wait_until
from tests.recordings.small_recording import (
    make_image,
    make_info,
    make_picture,
    make_state,
    make_view,
    refused,
)


class Gate:
    """Holds the writer thread up in its first write until opened: a disk that does not answer."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.opened = threading.Event()
        self.reached = threading.Event()
        original = RecordingWriter.event

        def slow_event(writer: RecordingWriter, event: CaptureEvent) -> None:
            self.reached.set()
            assert self.opened.wait(PATIENCE_S)
            original(writer, event)

        monkeypatch.setattr(RecordingWriter, "event", slow_event)


def event() -> CaptureEvent:
    return CaptureEvent(Stamps(), "note")


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Gate:
    return Gate(monkeypatch)


def held_up(gate: Gate, folder: Path) -> Recorder:
    """A recorder whose writer waits at the gate."""
    recorder = Recorder(folder / "a.mcap", make_info())
    recorder.event(event())
    assert gate.reached.wait(PATIENCE_S)
    return recorder


def test_a_session_from_several_threads_comes_back_complete(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mcap", make_info())

    def send_states() -> None:
        for count in range(2000):
            assert recorder.robot_state(make_state(count))

    robot = threading.Thread(target=send_states)
    robot.start()
    for index in range(10):
        recorder.image(make_picture(index))
        recorder.view(make_view(index))
        recorder.sync().result(PATIENCE_S)
    robot.join()
    recorder.attach("plan.yaml", "application/yaml", b"x")
    recording = open_recording(recorder.finish().result(PATIENCE_S))
    assert list(recording.robot_states()) == [make_state(i) for i in range(2000)]
    assert [view.index for view in recording.views()] == list(range(10))
    for view, picture in recording.images():
        np.testing.assert_array_equal(picture.pixels, make_image(view.index))


def test_sync_resolves_only_after_fdatasync_of_what_came_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    real_sync, real_view = os.fdatasync, RecordingWriter.view

    def fdatasync(descriptor: int) -> None:
        order.append(f"sync {os.fstat(descriptor).st_size}")
        real_sync(descriptor)

    def view(writer: RecordingWriter, written: object) -> None:
        real_view(writer, written)
        order.append(f"view {writer.part_path.stat().st_size}")

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    monkeypatch.setattr(RecordingWriter, "view", view)
    recorder = Recorder(tmp_path / "a.mcap", make_info(), clock=lambda: 0.0)
    recorder.image(make_picture(0))
    recorder.view(make_view(0))
    recorder.sync().result(PATIENCE_S)
    size = recorder.part_path.stat().st_size
    assert order == [f"view {size}", f"sync {size}"]
    recorder.close()


def test_data_reach_the_system_and_the_disk_without_being_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 0.0
    synced = threading.Event()
    real_sync = os.fdatasync

    def fdatasync(descriptor: int) -> None:
        real_sync(descriptor)
        if os.path.samestat(os.fstat(descriptor), recorder.part_path.stat()):  # none that a test left open
            synced.set()

    recorder = Recorder(tmp_path / "a.mcap", make_info(), clock=lambda: now_s)
    monkeypatch.setattr(os, "fdatasync", fdatasync)
    recorder.robot_state(make_state(0))
    now_s = recorder_module.FLUSH_PERIOD_S * 1.01
    wait_until(lambda: encode(make_state(0)) in recorder.part_path.read_bytes())
    assert not synced.is_set()
    now_s = recorder_module.SYNC_PERIOD_S * 1.01
    assert synced.wait(PATIENCE_S)
    recorder.close()


def test_what_is_on_the_disk_leaves_the_page_cache_but_for_the_newest_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[int, int, int]] = []
    monkeypatch.setattr(os, "posix_fadvise", lambda descriptor, *advice: told.append(advice))
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(make_picture(0))
        size_bytes = writer.part_path.stat().st_size
        for kept_bytes in (size_bytes, 1000):
            monkeypatch.setattr(writer_module, "KEPT_IN_MEMORY_BYTES", kept_bytes)
            writer.sync()
    assert told == [(0, size_bytes - 1000, os.POSIX_FADV_DONTNEED)], "a length of 0 would be all of it"


def test_what_a_sync_was_asked_for_has_left_the_process(tmp_path: Path) -> None:
    """Also where no image or view ended the open chunk."""
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.robot_state(make_state(3))
        writer.sync()
        assert encode(make_state(3)) in writer.part_path.read_bytes()


def test_nothing_is_acknowledged_after_a_regular_sync_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 0.0
    failures = [OSError(5, "Input/output error")]

    def fdatasync(descriptor: int) -> None:
        if failures:
            raise failures.pop()  # as the kernel does: it tells an error once

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    recorder = Recorder(tmp_path / "a.mcap", make_info(), clock=lambda: now_s)
    recorder.image(make_picture(0))
    now_s = recorder_module.SYNC_PERIOD_S * 1.01
    wait_until(lambda: not recorder.alive)
    for ask in (recorder.sync, recorder.finish):
        with refused("disk", errno=errno.EIO):
            ask().result(PATIENCE_S)


def test_a_disk_that_takes_seconds_for_every_sync_costs_no_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, syncs = 0.0, 0
    reached, opened = threading.Event(), threading.Event()

    def fdatasync(descriptor: int) -> None:
        nonlocal now_s, syncs
        reached.set()
        assert opened.wait(PATIENCE_S)
        now_s, syncs = now_s + 4.0, syncs + 1

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    recorder = Recorder(tmp_path / "a.mcap", make_info(), clock=lambda: now_s)
    now_s = recorder_module.SYNC_PERIOD_S * 1.01
    assert reached.wait(PATIENCE_S)
    assert all(recorder.robot_state(make_state(count)) for count in range(2000))
    opened.set()
    recording = open_recording(recorder.finish().result(PATIENCE_S))
    assert list(recording.robot_states()) == [make_state(count) for count in range(2000)]
    assert syncs == 1, "it would write a message for every 4 s"


def test_images_for_which_nobody_waits_do_not_fill_the_memory(gate: Gate, tmp_path: Path) -> None:
    recorder = held_up(gate, tmp_path)
    for sequence in range(recorder_module.IMAGES_LIMIT):
        recorder.image(make_picture(sequence))
    with refused("disk-too-slow"):
        recorder.image(make_picture(recorder_module.IMAGES_LIMIT))
    gate.opened.set()
    recorder.sync().result(PATIENCE_S)
    recorder.image(make_picture(recorder_module.IMAGES_LIMIT))
    recording = open_recording(recorder.finish().result(PATIENCE_S))
    assert recording.segments[0].image_sequences() == list(range(recorder_module.IMAGES_LIMIT + 1))


def test_the_callers_never_wait_for_the_disk(gate: Gate, tmp_path: Path) -> None:
    recorder = held_up(gate, tmp_path)
    limit = recorder_module.QUEUE_LIMIT_MESSAGES - 1  # beside the event that is being written
    kept = [recorder.robot_state(make_state(count)) for count in range(limit + 7)]
    assert kept == [True] * limit + [False] * 7
    recorder.event(event())
    done = recorder.sync()
    assert not done.done()
    gate.opened.set()
    done.result(PATIENCE_S)
    recorder.close()


def test_the_first_write_error_is_final_and_said_to_everyone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(tmp_path / "a.mcap", make_info())
    recorder.image(make_picture(0))
    recorder.view(make_view(0))
    recorder.sync().result(PATIENCE_S)
    safe = recorder.part_path.read_bytes()
    monkeypatch.setattr(OutputFile, "write", full)
    recorder.image(make_picture(1))
    with refused("disk", errno=errno.ENOSPC):
        recorder.sync().result(PATIENCE_S)
    assert recorder.error is not None
    monkeypatch.undo()  # space is free again, and still nothing more is written
    assert not recorder.robot_state(make_state(0))
    for call in (
        *[lambda: recorder.image(make_picture(2))] * recorder_module.IMAGES_LIMIT,
        lambda: recorder.view(make_view(2)),
        lambda: recorder.event(event()),
        lambda: recorder.sync().result(PATIENCE_S),
        lambda: recorder.finish().result(PATIENCE_S),
    ):
        with refused("disk", errno=errno.ENOSPC):
            call()
    assert recorder.part_path.read_bytes() == safe
    assert not (tmp_path / "a.mcap").exists()


def test_waiting_syncs_fail_with_the_error_and_nobody_hangs(
    gate: Gate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = held_up(gate, tmp_path)
    recorder.image(make_picture(0))
    waiting = [recorder.sync() for _ in range(3)]
    finishing = recorder.finish()
    monkeypatch.setattr(OutputFile, "write", full)
    gate.opened.set()
    for future in (*waiting, finishing):
        with refused("disk", errno=errno.ENOSPC):
            future.result(PATIENCE_S)


def test_an_error_of_the_last_sync_is_as_final(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder(tmp_path / "a.mcap", make_info(), clock=lambda: 0.0)
    recorder.image(make_picture(0))

    def fail(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fail)
    with refused("disk", errno=errno.EIO):
        recorder.finish().result(PATIENCE_S)
    assert not (tmp_path / "a.mcap").exists()


async def test_a_task_that_stops_waiting_does_not_harm_the_recording(gate: Gate, tmp_path: Path) -> None:
    recorder = held_up(gate, tmp_path)
    waiting = asyncio.wrap_future(recorder.sync())
    waiting.cancel()
    gate.opened.set()
    recorder.image(make_picture(0))
    assert (finished := recorder.finish()) is recorder.finish()
    assert open_recording(await asyncio.wrap_future(finished)).segments[0].image_sequences() == [0]


def test_closing_writes_what_waits_and_leaves_the_part_file_for_recovery(gate: Gate, tmp_path: Path) -> None:
    recorder = held_up(gate, tmp_path)
    recorder.image(make_picture(0))
    (closing := threading.Thread(target=recorder.close)).start()
    wait_until(lambda: not recorder.robot_state(make_state(0)))
    gate.opened.set()
    closing.join()
    recorder.close()
    assert make_picture(0).pixels.tobytes() in recorder.part_path.read_bytes()
    with refused("closed"):
        recorder.event(event())
    with refused("closed"):
        recorder.finish().result(PATIENCE_S)
