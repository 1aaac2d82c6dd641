"""Cost of recording: time per image of the writer against plain `write()` of the same bytes.

1280×1024 mono8 pictures of a noisy board, where said with 500 Hz robot states between them (6⅔ a picture at
75 fps), all ways in one run, each time in another order, because the disk of a shared machine changes its
speed from minute to minute. "To kernel" ends when the last picture was handed over, "to disk" after fsync;
"× plain" compares with the plain way that syncs as often.
"""

from __future__ import annotations

import os
import random
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recordings.reader import open_recording
from recordings.recorder import SYNC_PERIOD_S, Recorder
from recordings.schema.messages import (
    BoardKind,
    BoardSpec,
    CameraModel,
    Image,
    RobotState,
    SessionInfo,
    Stamps,
    View,
)
from recordings.writer import RecordingWriter

WIDTH, HEIGHT = 1280, 1024
FRAMES = 150
REPEATS = 15
SESSION_S = 600.0
STOPS = 25
PLAIN = "plain write() of the pictures"
PLAIN_SYNCED = "plain write(), fdatasync every 0.5 s"
STATES_A_FRAME = 500 / 75
_INFO = SessionInfo(
    name="benchmark",
    mount="eye-in-hand",
    source="simulated",
    board=BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025),
    camera=CameraModel(WIDTH, HEIGHT),
)
_POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


Written = Callable[[], None]
"""Called when the last picture was handed to the operating system: sealing and syncing come after."""


@dataclass
class Way:
    """One way of writing; each run appends to the lists, milliseconds per picture."""

    name: str
    write: Callable[[Path, list[NDArray[np.uint8]], Written], None]
    floor: str = PLAIN
    """The plain way that does the same to the disk."""
    written_ms: list[float] = field(default_factory=list)
    """Wall time until the last picture was handed to the operating system."""
    on_disk_ms: list[float] = field(default_factory=list)
    """Wall time until everything was on the disk."""
    cpu_ms: list[float] = field(default_factory=list)
    """Processor time of the process, until the last picture was handed over."""
    megabytes: float = 0.0


def frames() -> list[NDArray[np.uint8]]:
    """A board-like picture with sensor noise (σ = 1.5 grey levels), eight different ones."""
    rng = np.random.default_rng(7)
    squares = (np.indices((HEIGHT, WIDTH)) // 100).sum(axis=0) % 2
    clean = np.where(squares == 1, 200.0, 40.0)
    return [np.clip(clean + rng.normal(0, 1.5, clean.shape), 0, 255).astype(np.uint8) for _ in range(8)]


def _state(count: int) -> RobotState:
    joints = (0.1, -1.5, 1.2, 0.3, 0.2, count * 1e-6)
    stamps = Stamps(count, 1_700_000_000_000_000_000 + count * 2_000_000, count * 0.002)
    return RobotState(stamps, joints, joints, joints, joints, 7, 1, 1, 2, 3, 1.0, 1.0)


def _plain(path: Path, images: list[NDArray[np.uint8]], written: Written, period_s: float = 1e9) -> None:
    """`period_s`: between two fdatasync."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    synced_s = time.monotonic()
    for index in range(FRAMES):
        os.write(descriptor, images[index % len(images)].data)
        if time.monotonic() - synced_s > period_s:
            os.fdatasync(descriptor)
            synced_s = time.monotonic()
    written()
    os.fsync(descriptor)
    os.close(descriptor)


def _plain_synced(path: Path, images: list[NDArray[np.uint8]], written: Written) -> None:
    _plain(path, images, written, SYNC_PERIOD_S)


def _written(
    path: Path,
    images: list[NDArray[np.uint8]],
    written: Written,
    states_a_frame: float = STATES_A_FRAME,
) -> None:
    with RecordingWriter(path, _INFO) as writer:
        states = 0
        for index in range(FRAMES):
            while states < index * states_a_frame:
                writer.robot_state(_state(states))
                states += 1
            writer.image(Image(images[index % len(images)], Stamps(), index, index))
        written()
        writer.finish()


def _pictures_only(path: Path, images: list[NDArray[np.uint8]], written: Written) -> None:
    _written(path, images, written, states_a_frame=0)


def _recorded(path: Path, images: list[NDArray[np.uint8]], written: Written) -> None:
    """Through the recorder's thread and queue, as a session does; waits when the queue is half full."""
    recorder = Recorder(path, _INFO)
    states = 0
    for index in range(FRAMES):
        while states < index * STATES_A_FRAME:
            recorder.robot_state(_state(states))
            states += 1
        while recorder.queued_bytes > 64 * 1024 * 1024:
            time.sleep(0.001)
        if not recorder.image(Image(images[index % len(images)], Stamps(), index, index)):
            raise RuntimeError("a picture was dropped")
    while recorder.queued_bytes:
        time.sleep(0.001)
    written()
    recorder.finish().result()


def _session(path: Path, images: list[NDArray[np.uint8]]) -> str:
    """At its own pace: 500 Hz of states from a thread of their own, and stops whose image is awaited."""
    recorder, started_s, cpu_s = Recorder(path, _INFO), time.monotonic(), time.process_time()
    count = int(SESSION_S * 500)

    def report() -> None:
        for number in range(count):
            time.sleep(max(0.0, started_s + number / 500 - time.monotonic()))
            recorder.robot_state(_state(number))

    robot = threading.Thread(target=report)
    robot.start()
    slowest_s = 0.0
    for stop in range(STOPS):
        time.sleep(max(0.0, started_s + stop * SESSION_S / STOPS - time.monotonic()))
        taken_s = time.monotonic()
        recorder.image(Image(images[stop % len(images)], Stamps(), stop, stop))
        recorder.view(View(stop, str(stop), stop, _POSE))
        recorder.sync().result()
        slowest_s = max(slowest_s, time.monotonic() - taken_s)
    robot.join()
    recording = open_recording(recorder.finish().result())
    busy = (time.process_time() - cpu_s) / (time.monotonic() - started_s)
    lost = count - sum(1 for _ in recording.robot_states())
    return (
        f"A session of {SESSION_S:g} s, {STOPS} stops: {len(recording.views())} views kept, {lost} states of "
        f"{count} lost, slowest stop on the disk after {slowest_s * 1e3:.0f} ms, {busy:.0%} of a core."
    )


def _ways() -> list[Way]:
    return [
        Way(PLAIN, _plain),
        Way(PLAIN_SYNCED, _plain_synced, PLAIN_SYNCED),
        Way("RecordingWriter, pictures only", _pictures_only),
        Way("RecordingWriter, with 500 Hz states", _written),
        Way("Recorder (thread, states, fdatasync every 0.5 s)", _recorded, PLAIN_SYNCED),
    ]


def _run_once(way: Way, path: Path, images: list[NDArray[np.uint8]]) -> None:
    marks: list[tuple[float, float]] = []

    def mark() -> None:
        marks.append((time.perf_counter(), time.process_time()))

    os.sync()
    mark()
    way.write(path, images, mark)
    mark()
    (start_s, start_cpu_s), (written_s, written_cpu_s), (end_s, _) = marks
    way.written_ms.append((written_s - start_s) * 1e3 / FRAMES)
    way.cpu_ms.append((written_cpu_s - start_cpu_s) * 1e3 / FRAMES)
    way.on_disk_ms.append((end_s - start_s) * 1e3 / FRAMES)
    way.megabytes = path.stat().st_size / 1e6


def run() -> str:
    """A markdown table; medians of interleaved repeats."""
    folder = Path(tempfile.mkdtemp(prefix="recorder-"))
    ways, images = _ways(), frames()
    read_ms: list[float] = []
    try:
        for repeat in range(REPEATS):
            for way in random.Random(repeat).sample(ways, len(ways)):
                path = folder / "a.mcap"
                _run_once(way, path, images)
                if way.write is _written:
                    start_s = time.perf_counter()
                    open_recording(path)
                    read_ms.append((time.perf_counter() - start_s) * 1e3 / FRAMES)
                path.unlink()
        session = _session(folder / "session.mcap", images)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return f"{_table(ways, statistics.median(read_ms))}\n\n{session}"


def _table(ways: list[Way], read_ms: float) -> str:
    floors = {way.name: way for way in ways}
    lines = [
        (
            f"{FRAMES} pictures of {WIDTH}×{HEIGHT} mono8, {REPEATS} repeats, each in another order; "
            "all times per picture."
        ),
        "",
        "| way | ms to kernel, min / median / max | × plain | CPU ms | × plain | ms to disk | × plain | MB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for way in ways:
        floor = floors[way.floor]
        spread = " / ".join(f"{f(way.written_ms):.2f}" for f in (min, statistics.median, max))
        wall = statistics.median(way.written_ms) / statistics.median(floor.written_ms)
        cpu = statistics.median(way.cpu_ms)
        disk = statistics.median(way.on_disk_ms)
        lines.append(
            f"| {way.name} | {spread} | {wall:.2f} | {cpu:.2f} | {cpu / statistics.median(floor.cpu_ms):.2f} "
            f"| {disk:.2f} | {disk / statistics.median(floor.on_disk_ms):.2f} | {way.megabytes:.0f} |"
        )
    lines += ["", f"Opening (strict pass over every byte, SHA-256 included): {read_ms:.2f} ms per picture."]
    return "\n".join(lines)


if __name__ == "__main__":
    print(run())
