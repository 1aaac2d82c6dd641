"""A network namespace of its own for a test: discovery of GigE cameras broadcasts on every interface."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from station.cell.errors import StationError
from station.simulation.netns import bring_lo_up

_CLONE_NEWNET = 0x40000000


@contextmanager
def isolated_thread() -> Iterator[None]:
    """The calling thread, and the threads and children it starts, in a namespace with only `lo`.

    Needs root; StationError otherwise.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open("rb") as before:
        if libc.unshare(_CLONE_NEWNET) != 0:
            reason = os.strerror(ctypes.get_errno())
            raise StationError("no-namespace", reason=reason)
        try:
            bring_lo_up()
            yield
        finally:
            libc.setns(before.fileno(), _CLONE_NEWNET)
