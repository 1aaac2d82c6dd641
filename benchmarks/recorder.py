"""What does recording cost? Time per picture of the writer against plain `write()` of the same bytes.

1280×1024 mono8 pictures of a noisy board with 500 Hz robot states between them (6⅔ a picture at 75 fps), all
ways in turn in one run, because the disk of a shared machine changes its speed from minute to minute.
"""

from __future__ import annotations

import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recordings.messages import BoardKind, BoardSpec, CameraModel, Picture, RobotState, SessionInfo, Stamps
from recordings.reader import open_recording
from recordings.recorder import Recorder
from recordings.writer import RecordingWriter

WIDTH, HEIGHT = 1280, 1024
FRAMES = 150
REPEATS = 5
STATES_A_FRAME = 500 / 75
_INFO = SessionInfo(
    name="benchmark",
    mount="eye-in-hand",
    source="simulated",
    board=BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025),
    camera=CameraModel(WIDTH, HEIGHT),
)


@dataclass
class Way:
    """One way of writing; each run appends to the lists, milliseconds per picture."""

    name: str
    write: Callable[[Path, list[NDArray[np.uint8]]], Path]
    wall_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
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


def _plain(path: Path, images: list[NDArray[np.uint8]]) -> Path:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    for index in range(FRAMES):
        os.write(descriptor, images[index % len(images)].data)
    os.close(descriptor)
    return path


def _written(path: Path, images: list[NDArray[np.uint8]], lossless_png: bool = False) -> Path:
    with RecordingWriter(path, _INFO, lossless_png=lossless_png) as writer:
        states = 0
        for index in range(FRAMES):
            while states < index * STATES_A_FRAME:
                writer.robot_state(_state(states))
                states += 1
            writer.picture(Picture(images[index % len(images)], Stamps(), index, index))
        return writer.finish()


def _written_png(path: Path, images: list[NDArray[np.uint8]]) -> Path:
    return _written(path, images, lossless_png=True)


def _recorded(path: Path, images: list[NDArray[np.uint8]]) -> Path:
    """Through the recorder's thread and queue, as a session does; waits when the queue is half full."""
    recorder = Recorder(path, _INFO)
    states = 0
    for index in range(FRAMES):
        while states < index * STATES_A_FRAME:
            recorder.robot_state(_state(states))
            states += 1
        while recorder.queued_bytes > 64 * 1024 * 1024:
            time.sleep(0.001)
        if not recorder.picture(Picture(images[index % len(images)], Stamps(), index, index)):
            raise RuntimeError("a picture was dropped")
    return recorder.finish().result()


def _foxglove(path: Path, images: list[NDArray[np.uint8]]) -> Path:
    import foxglove
    from foxglove.channels import RawImageChannel
    from foxglove.mcap import MCAPWriteOptions
    from foxglove.messages import RawImage

    channel = RawImageChannel("/camera/image")
    writer = foxglove.open_mcap(path, writer_options=MCAPWriteOptions(compression=None))
    for index in range(FRAMES):
        data = images[index % len(images)].tobytes()
        channel.log(
            RawImage(frame_id="camera", width=WIDTH, height=HEIGHT, encoding="mono8", step=WIDTH, data=data)
        )
    writer.close()
    channel.close()
    return path


def _ways() -> list[Way]:
    ways = [
        Way("plain write() of the pictures", _plain),
        Way("RecordingWriter, raw", _written),
        Way("Recorder (thread, fdatasync every 0.5 s)", _recorded),
        Way("RecordingWriter, lossless PNG", _written_png),
    ]
    try:
        import foxglove  # noqa: F401
    except ImportError:
        return ways
    return [*ways, Way("foxglove-sdk, pictures only, uncompressed", _foxglove)]


def run() -> str:
    """A markdown table; medians of interleaved repeats."""
    folder = Path(tempfile.mkdtemp(prefix="recorder-"))
    ways, images = _ways(), frames()
    read_ms: list[float] = []
    try:
        for _ in range(REPEATS):
            for way in ways:
                path = folder / "a.mcap"
                wall_s, cpu_s = time.perf_counter(), time.process_time()
                way.write(path, images)
                way.wall_ms.append((time.perf_counter() - wall_s) * 1e3 / FRAMES)
                way.cpu_ms.append((time.process_time() - cpu_s) * 1e3 / FRAMES)
                way.megabytes = path.stat().st_size / 1e6
                if way.write is _written:
                    start_s = time.perf_counter()
                    open_recording(path)
                    read_ms.append((time.perf_counter() - start_s) * 1e3 / FRAMES)
                path.unlink()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return _table(ways, statistics.median(read_ms))


def _table(ways: list[Way], read_ms: float) -> str:
    floor = statistics.median(ways[0].wall_ms)
    lines = [
        f"{FRAMES} pictures of {WIDTH}×{HEIGHT} mono8, 500 Hz robot states, {REPEATS} interleaved repeats.",
        "",
        "| way | ms per picture, min / median / max | × plain write | CPU ms per picture | file MB |",
        "|---|---|---|---|---|",
    ]
    for way in ways:
        spread = " / ".join(f"{f(way.wall_ms):.2f}" for f in (min, statistics.median, max))
        factor = statistics.median(way.wall_ms) / floor
        cpu = statistics.median(way.cpu_ms)
        lines.append(f"| {way.name} | {spread} | {factor:.2f} | {cpu:.2f} | {way.megabytes:.0f} |")
    lines += ["", f"Opening (strict pass over every byte, SHA-256 included): {read_ms:.2f} ms per picture."]
    return "\n".join(lines)


if __name__ == "__main__":
    print(run())
