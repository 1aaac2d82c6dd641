"""Coverage-guided fuzzing of the strict reader and of recovery, with atheris (pytest does not collect it).

    python -m venv /tmp/fuzz && /tmp/fuzz/bin/pip install atheris -e .
    mkdir -p /tmp/corpus
    /tmp/fuzz/bin/python tests/fuzz/fuzz_recordings.py /tmp/corpus -max_total_time=3600

Checksums are switched off (every CRC is 0 on both sides), so that mutations reach the code behind them. Any
exception but RecordingError, more than 256 MiB of memory or more than 10 s for one input is a finding.
"""

from __future__ import annotations

import os
import resource
import sys
import zlib
from contextlib import suppress
from pathlib import Path

import atheris
import cv2

sys.path.insert(0, str(Path(__file__).parents[2]))

with atheris.instrument_imports(include=["recordings"]):
    from recordings.errors import RecordingError
    from recordings.reader import open_recording
    from recordings.recover import recover_recording
    from recordings.writer import RecordingWriter

from tests.recordings.small_recording import (  # after instrumentation
    make_info,
    make_picture,
    make_view,
    write_small,
)

zlib.crc32 = lambda data, value=0: 0
SCRATCH = Path("/dev/shm") / f"fuzz-recordings-{os.getpid()}"
MEMORY_LIMIT_BYTES = 256 * 1024 * 1024


def seeds(corpus: Path) -> None:
    """Small recordings: raw pictures, PNG and JPEG."""
    for name, make in {
        "raw-0": lambda path: write_small(path, poses=0),
        "raw-1": lambda path: write_small(path, poses=1),
        "raw-2": lambda path: write_small(path, poses=2),
        "png": lambda path: write_encoded(path, ".png"),
        "jpeg": lambda path: write_encoded(path, ".jpg"),
    }.items():
        path = corpus / f"seed-{name}.mcap"
        if not path.exists():
            make(path)


def write_encoded(path: Path, extension: str) -> None:
    with RecordingWriter(path, make_info()) as writer:
        picture = make_picture(0)
        writer.image(picture, encoded=cv2.imencode(extension, picture.pixels)[1].tobytes())
        writer.view(make_view(0))
        writer.finish()


def read_all(path: Path) -> None:
    recording = open_recording(path)
    for _ in recording.robot_states():
        pass
    for _ in recording.events():
        pass
    for view in recording.views():
        recording.image(view)
    recording.attachments()


def one_input(data: bytes) -> None:
    source, output = SCRATCH / "a.mcap", SCRATCH / "b.mcap"
    source.write_bytes(data)
    for attempt in (lambda: read_all(source), lambda: read_all(recover_recording(source, output)[0].path)):
        with suppress(RecordingError):
            attempt()
    output.unlink(missing_ok=True)
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if peak_bytes > MEMORY_LIMIT_BYTES:
        raise MemoryError(f"{peak_bytes >> 20} MiB")


if __name__ == "__main__":
    SCRATCH.mkdir(mode=0o700, exist_ok=True)
    for argument in sys.argv[1:]:
        if Path(argument).is_dir():
            seeds(Path(argument))
    atheris.Setup([*sys.argv, "-timeout=10", "-max_len=60000"], one_input)
    atheris.Fuzz()
