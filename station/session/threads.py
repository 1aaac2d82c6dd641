"""Threads of the daemon for each kind of work: what hangs in one holds up neither another nor the loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import BoundedSemaphore
from typing import ParamSpec, TypeVar

from station.cell.errors import RefusedError

P = ParamSpec("P")
R = TypeVar("R")


class WorkThreads:
    """A few threads for one kind of work, which may hang for ever: on a dead file server, for instance."""

    def __init__(self, name: str, threads: int, waiting: int = 100) -> None:
        """`waiting`: so much may wait for a free thread."""
        self._pool = ThreadPoolExecutor(threads, f"station {name}")
        self._places = BoundedSemaphore(threads + waiting)

    async def run(self, work: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """The result of `work`, or its exception. RefusedError where too much waits already."""
        if not self._places.acquire(blocking=False):
            raise RefusedError(
                "Too many requests wait for this computer's disk or network.",
                code="busy",
                remedy="Check the disk and the network of the station's computer, then try again.",
            )
        work_done = self._pool.submit(work, *args, **kwargs)
        work_done.add_done_callback(lambda _: self._places.release())
        return await asyncio.wrap_future(work_done)


MOTION = WorkThreads("motion", 2)
"""Checks of a path that is approved or about to be."""
DISK = WorkThreads("disk", 3)
"""The session's own files."""
ASKED = WorkThreads("asked", 4, 8)
"""What a person asked to see: files and devices, however many and slow."""
WATCH = WorkThreads("watch", 1)
"""What the status tells of files."""
NAMES = WorkThreads("names", 2)
"""Names of users, which may come from the network."""
