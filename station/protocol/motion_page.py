"""The daemon's word to `station stop`: how many STOPs it carried out, and whether the arm rests.

A small file beside the socket that only the daemon's user can have made. Answers would go through a queue
that somebody else can fill; a file is read by any number of readers, and nobody can hold it up.
"""

from __future__ import annotations

import os
import stat
import struct
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

_MAGIC = b"STATION1"
_LAYOUT = struct.Struct("<8sIIQ")


class Motion(IntEnum):
    UNKNOWN = 0
    """No fresh state from the robot"""
    MOVES = 1
    RESTS = 2


class Page(NamedTuple):
    pid: int
    motion: Motion
    stops: int
    """STOPs that were carried out in the daemon's life."""


def packed(page: Page) -> bytes:
    return _LAYOUT.pack(_MAGIC, page.pid, page.motion, page.stops)


def create_page(path: Path, page: Page) -> int:
    """The descriptor of a new file, readable by the group. Raises OSError."""
    path.unlink(missing_ok=True)
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(path, flags, 0o640)
    os.fchmod(descriptor, 0o640)  # whatever the umask
    write_page(descriptor, page)
    return descriptor


def write_page(descriptor: int, page: Page) -> None:
    """In one call; a disk that is full or stuck may refuse it or take long. Raises OSError."""
    os.pwrite(descriptor, packed(page), 0)


def open_page(path: Path, owners: set[int]) -> int:
    """A descriptor to read from. Raises PermissionError where the file is not one of `owners`', OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_uid not in owners:
        os.close(descriptor)
        raise PermissionError(1, "not the daemon's", str(path))
    return descriptor


def read_page(descriptor: int) -> Page | None:
    """None when it is not (yet) a whole page."""
    raw = os.pread(descriptor, _LAYOUT.size, 0)
    if len(raw) != _LAYOUT.size or raw != os.pread(descriptor, _LAYOUT.size, 0):  # just being written
        return None
    magic, pid, motion, stops = _LAYOUT.unpack(raw)
    if magic != _MAGIC or motion not in Motion._value2member_map_:
        return None
    return Page(pid, Motion(motion), stops)
