"""Foreign files are read in a process of their own: what a library dies of there ends an import in an error.

`look`, `read_described`, `read_headers` and `read_bag` each start one reader (`reader_main`), which limits
itself and answers with plain data (`reader_messages`). It works from any program and any thread: the reader
is a fresh Python, never a fork. Decision 0128 says what is limited, and what is not.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from recordings import errors
from recordings.errors import ErrorData, ImportSourceError, RecordingError
from recordings.importers.dataset import Dataset, PoseLine, PoseRow, pose_rows
from recordings.importers.messages import Progress
from recordings.importers.reader_messages import (
    Advanced,
    Answer,
    Broken,
    DescribedRead,
    FolderRead,
    HeadersRead,
    LookInto,
    ReadBag,
    ReadDescribed,
    ReadHeaders,
    Reading,
    Refused,
    Request,
    packed,
    read_frame,
)
from recordings.importers.selection import Wanted
from recordings.importers.stops import StandstillLimits
from recordings.importers.tables import Contents, ShortTable, Table

CPU_LIMIT_S = 15
"""Of a reader: folders of the usual size need one second of it."""
_CPU_S_PER_MB = 0.5
"""More for a bag."""
SILENCE_LIMIT_S = 120.0
"""A reader that says nothing for so long waits for a disk that does not answer."""
_END_WAIT_S = 5.0
_PIECE_BYTES = 1024 * 1024
_SIGNAL_CAUSES: dict[int, str] = {signal.SIGXCPU: "time", signal.SIGXFSZ: "disk"}
_REASONS = {
    "time": "it takes more computing time than any such file needs",
    "memory": "it takes more memory than any such file needs",
    "disk": "unpacked it is larger than any such file needs to be",
    "silent": f"nothing was read for {SILENCE_LIMIT_S:.0f} s: its disk does not answer",
    "crashed": "the library that reads it crashed",
    "no-answer": "its reader said what nobody understands",
    "not-started": "its reader, a process of its own, could not be started",
}

T = TypeVar("T")
Frame = tuple[Answer, list[bytes]]
"""An answer and its raw bytes."""


@dataclass(frozen=True)
class Described:
    """A folder with dataset.yaml and poses.csv."""

    dataset: Dataset
    rows: list[PoseRow]
    beside: dict[str, bytes]
    """Contents of the files that a recording keeps, by name."""
    newest_ns: int
    """When the newest image was written."""


def look(source: Path, poses: Path | None = None) -> Contents:
    """Read what lies in anyone's folder, or one file, as `tables.look` does. Raises RecordingError."""
    request = LookInto(str(source), None if poses is None else str(poses))
    found, blobs = _only(request, source, FolderRead)
    try:
        return _contents(found, blobs)
    except ValueError as error:
        raise unexpected(source) from error


def read_described(folder: Path, newest: int | None = None) -> Described:
    """Read a folder with dataset.yaml and poses.csv, and check the headers of the images.

    `newest`: only the last so many rows; None: all. Raises RecordingError with file and line.
    """
    found, blobs = _only(ReadDescribed(str(folder), newest), folder, DescribedRead)
    lines = [PoseLine(**msgspec.structs.asdict(pose)) for pose in found.poses]
    beside = dict(zip(found.attached, blobs, strict=True))
    return Described(found.dataset, pose_rows(lines), beside, found.newest_ns)


def read_headers(folder: Path, rows: Sequence[PoseRow], size: tuple[int, int]) -> int:
    """Check the headers of the rows' images against a size. Returns when the newest was written, ns.

    Raises RecordingError with file and line.
    """
    images = [(row.line, row.image) for row in rows if row.camera_from_board is None]
    if not images:
        return 0
    return _only(ReadHeaders(str(folder), images, size), folder, HeadersRead)[0].newest_ns


@contextmanager
def read_bag(
    source: Path,
    description: Path | None,
    wanted: Wanted,
    limits: StandstillLimits,
    pair_within_s: float,
    views: bool,
    progress: Progress,
) -> Generator[Generator[Frame]]:
    """Yield what `bag_views.read_bag` yields. Raises RecordingError."""
    request = ReadBag(
        str(source),
        None if description is None else str(description),
        astuple(wanted),
        astuple(limits),
        pair_within_s,
        views,
    )
    cpu_limit_s = CPU_LIMIT_S + int(_CPU_S_PER_MB * _size_bytes(source) / 1e6)
    with _answers(request, source, cpu_limit_s, progress) as answers:
        yield answers


def _size_bytes(source: Path) -> int:
    with suppress(OSError):
        files = list(source.iterdir()) if source.is_dir() else [source]
        return sum(file.stat().st_size for file in files if file.is_file())
    return 0


def _only(request: Request, source: Path, kind: type[T]) -> tuple[T, list[bytes]]:
    """The one answer to a request. RecordingError where there is none."""
    with _answers(request, source, CPU_LIMIT_S) as answers:
        for answer, blobs in answers:
            if isinstance(answer, kind):
                return answer, blobs
    raise unexpected(source)


@contextmanager
def _answers(
    request: Request,
    source: Path,
    cpu_limit_s: int,
    progress: Progress = lambda done, total, text: None,
) -> Generator[Generator[Frame]]:
    """Start a reader for a `with` block, in which its answers come one by one."""
    environment = os.environ | {
        "OPENBLAS_NUM_THREADS": "1",  # each thread reserves memory
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(_module_path()),
    }
    # -P: a module of the folder in which the user stands is never taken for one of ours
    command = [sys.executable, "-P", "-m", "recordings.importers.reader_main", str(cpu_limit_s)]
    try:
        process = subprocess.Popen(
            [*command, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
    except OSError as error:
        raise _error("not-started", source, str(error)) from error
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        with suppress(BrokenPipeError):  # one that cannot start says so by its end
            process.stdin.write(b"".join(packed(request)))
            process.stdin.flush()
        yield _frames(process, source, progress)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        with suppress(BrokenPipeError):
            process.stdin.close()


def _module_path() -> list[str]:
    """Where this process finds modules: the reader finds the same ones."""
    own = str(Path(__file__).parents[2])
    path = [each for each in sys.path if each]
    return path if own in path else [*path, own]


def _frames(process: subprocess.Popen[bytes], source: Path, progress: Progress) -> Generator[Frame]:
    """Yield the answers with content. RecordingError for a refusal and for a reader that died."""
    assert process.stdout is not None
    descriptor = process.stdout.fileno()
    reads = source
    has_answered = False
    has_content = False
    while True:
        try:
            plain, blobs = read_frame(lambda length: _exactly(descriptor, length))
            answer: Any = msgspec.convert(plain, Answer, strict=True)
        except EOFError:
            cause = _cause_of_death(process, has_answered)
            if cause == "" and has_content:
                return
            raise _error(cause or "no-answer", reads) from None
        except TimeoutError:
            raise _error("silent", reads) from None
        except (ValueError, RecursionError, msgspec.ValidationError) as error:
            raise _error("no-answer", reads) from error
        has_answered = True
        match answer:
            case Reading():
                reads = Path(answer.file)
            case Advanced():
                progress(answer.done, answer.total, answer.text)
            case Refused():
                kinds = {kind.__name__: kind for kind in vars(errors).values() if _is_recordings(kind)}
                told = ErrorData(answer.code, answer.text, answer.remedy, dict(answer.values))
                raise kinds.get(answer.kind, RecordingError).from_data(told)
            case Broken():
                raise _error(answer.cause, reads, answer.reason)
            case _:
                has_content = True
                yield answer, blobs


def _is_recordings(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, RecordingError)


def _exactly(descriptor: int, length: int) -> bytes:
    """So many bytes of the pipe. EOFError at its end, TimeoutError where nothing comes."""
    parts: list[bytes] = []
    missing = length
    give_up_s = time.monotonic() + SILENCE_LIMIT_S
    waiting = select.poll()
    waiting.register(descriptor, select.POLLIN)
    while missing:
        if not waiting.poll(1e3 * max(0.0, give_up_s - time.monotonic())):
            raise TimeoutError
        part = os.read(descriptor, min(missing, _PIECE_BYTES))
        if not part:
            raise EOFError
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


def _cause_of_death(process: subprocess.Popen[bytes], has_answered: bool) -> str:
    """Why the reader has closed its pipe; empty: it has said everything."""
    try:
        code = process.wait(_END_WAIT_S)
    except subprocess.TimeoutExpired:
        return "crashed"
    if code == 0:
        return ""
    if code > 0 and not has_answered:
        return "not-started"
    return _SIGNAL_CAUSES.get(-code, "crashed")


def unexpected(source: Path) -> ImportSourceError:
    """An answer came that belongs to another request, or none."""
    return _error("no-answer", source)


def _error(cause: str, file: Path, reason: str = "") -> ImportSourceError:
    """The one error for whatever a library raises or dies of."""
    said = _REASONS.get(cause, "the library that reads it failed")
    return ImportSourceError(
        "foreign-file", path=file, cause=cause, reason=f"{said} ({reason})" if reason else said
    )


def _contents(found: FolderRead, blobs: list[bytes]) -> Contents:
    """The folder as `tables.look` finds it. RecordingError where numbers and their description differ."""
    tables = []
    for table, blob in zip(found.tables, blobs, strict=True):
        numbers = np.frombuffer(bytearray(blob)).reshape(len(table.images), table.columns)
        tables.append(Table(table.name, table.rotation, numbers, table.images, table.places, table.files))
    return Contents(
        root=Path(found.root),
        images={alike: list(map(Path, paths)) for alike, paths in found.images.items()},
        tables=tables,
        cameras=[(np.array(matrix), distortion) for matrix, distortion in found.cameras],
        facts=dict(found.facts),
        words=found.words,
        files=found.files,
        described_by=found.described_by,
        unread=found.unread,
        told=None if found.told is None else [tables[place] for place in found.told],
        told_as=found.told_as,
        short=[ShortTable(name, rows) for name, rows in found.short],
    )
