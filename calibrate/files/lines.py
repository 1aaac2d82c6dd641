"""Append-only files of JSON lines: a line is durable once written, and a torn line loses only itself."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import msgspec

from recordings.files import LOG_LIMIT_BYTES, open_regular

S = TypeVar("S", bound=msgspec.Struct)


def append_line(path: Path, entry: object) -> None:
    """Append a struct or dataclass. Raises OSError. A line that a crash left half-written is ended first."""
    new = not path.exists()
    with os.fdopen(open_regular(path, os.O_RDWR | os.O_APPEND | os.O_CREAT), "a+b") as file:
        if new:
            share(path)
        if file.tell() > 0:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")
        file.write(msgspec.json.encode(entry) + b"\n")
        file.flush()
        os.fsync(file.fileno())


def share(path: Path) -> None:
    """Let the group do with a new file or folder what its owner may, where the group shares its place."""
    if path.parent.stat().st_mode & stat.S_IWGRP:
        mode = path.stat().st_mode
        with suppress(PermissionError):  # another operator made it
            path.chmod(mode | (mode & stat.S_IRWXU) >> 3)


def read_lines(path: Path, kind: type[S]) -> list[S]:
    """Read a file, oldest line first; empty when there is none. Lines that are no `kind` are skipped.

    Of one that has grown beyond the limit, its end. Raises OSError.
    """
    try:
        descriptor = open_regular(path)
    except FileNotFoundError:
        return []
    with os.fdopen(descriptor, "rb") as file:
        file.seek(max(file.seek(0, os.SEEK_END) - LOG_LIMIT_BYTES, 0))
        lines = file.read().splitlines()
    found = []
    for line in lines:
        with suppress(msgspec.DecodeError, UnicodeDecodeError):
            found.append(msgspec.json.decode(line, type=kind))
    return found
