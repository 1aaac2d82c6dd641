"""Write the log of a camera's installations: append a sealed line, and keep the log short."""

from __future__ import annotations

import errno
import os
from collections import deque
from collections.abc import Iterable
from io import FileIO
from pathlib import Path

import msgspec

from calibrate.files.lines import share
from calibrate.files.sealed_lines import is_torn, seal
from calibrate.files.validity import NO_RECORD
from calibrate.files.validity_log import (
    FILE,
    LONGEST_LINE_BYTES,
    LogLine,
    ValidityLog,
    log_lines,
    read_validity_log,
)
from recordings.files import open_regular, sync_folder, write_atomically

ROTATE_BYTES = 1024 * 1024
"""Size from which the next line begins a shorter log: some thousand lines."""


def append_to_log(folder: Path, entry: object, versions: Iterable[int]) -> None:
    """Add a line, durably: `entry` is a dict, struct or dataclass. Call with the folder locked.

    `versions`: those that exist. A log that has become long is replaced by its newest lines and the last
    validity of each of these versions. A log of before is replaced by one that has all its lines sealed.

    Raises OSError; then the log says what it said before.
    """
    line = seal(msgspec.json.encode(entry))
    path = folder / FILE
    if len(line) >= LONGEST_LINE_BYTES:
        raise OSError(errno.EMSGSIZE, "the reason is too long for the log", str(path))
    log = read_validity_log(folder)
    size_bytes = path.stat().st_size if path.exists() else 0
    kept: list[bytes] | None = None
    if size_bytes > ROTATE_BYTES:
        newest = _newest(folder, log, set(versions))
        if log.is_of_before or sum(map(len, newest)) < size_bytes / 2:
            kept = newest
    elif log.is_of_before:
        kept = [_sealed(one, log) for one in log_lines(folder)]
    if kept is None:
        _append(path, line)
    else:
        content = b"".join(one + b"\n" for one in (*kept, line))
        write_atomically(path, content, like=path)


def _sealed(line: LogLine, log: ValidityLog) -> bytes:
    """The line with a checksum, where the log is one of before. A damaged one stays as it is."""
    return seal(line.written) if log.is_of_before and line.validity is not None else line.written


def _newest(folder: Path, log: ValidityLog, versions: set[int]) -> list[bytes]:
    """The newest lines, half of what the log may hold, behind what else holds of each version."""
    newest: deque[bytes] = deque()
    size_bytes = 0
    dropped = 0
    for line in log_lines(folder):
        newest.append(_sealed(line, log))
        size_bytes += len(newest[-1]) + 1
        while size_bytes > ROTATE_BYTES // 2:
            size_bytes -= len(newest.popleft()) + 1
            dropped += 1
    older = [log.of(version) for version in sorted(versions) if log.last_line(version) < dropped]
    recorded = [held for held in older if held.reason.code != NO_RECORD]
    return [*(seal(msgspec.json.encode(held)) for held in recorded), *newest]


def _append(path: Path, line: bytes) -> None:
    new = not path.exists()
    # Unbuffered: what could not be written must not be tried again when the file is closed.
    with os.fdopen(open_regular(path, os.O_RDWR | os.O_CREAT), "r+b", buffering=0) as file:
        if new:
            share(path)
        begin = _end_of_whole_lines(file)
        try:
            _write(file, begin, line + b"\n")
            if new:
                sync_folder(path.parent)
        except OSError:
            file.truncate(begin)
            raise


def _end_of_whole_lines(file: FileIO) -> int:
    """Return where the next line begins, after a line that lacks its line feed alone was given one.

    What a crash left half-written there goes first, and durably, so that no crash mixes it with the new line.
    """
    size_bytes = file.seek(0, os.SEEK_END)
    file.seek(max(size_bytes - LONGEST_LINE_BYTES, 0))
    last = file.readall().rpartition(b"\n")[2]
    if not last:
        return size_bytes
    if is_torn(last):
        begin = size_bytes - len(last)
        file.truncate(begin)
        os.fsync(file.fileno())
        return begin
    _write(file, size_bytes, b"\n")
    return size_bytes + 1


def _write(file: FileIO, begin: int, content: bytes) -> None:
    """Write all of it at `begin`, durably: a nearly full disk takes a part."""
    file.seek(begin)
    left = memoryview(content)
    while left:
        left = left[file.write(left) :]
    os.fsync(file.fileno())
