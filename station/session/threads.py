"""Separate threads for each kind of blocking work, so that none delays another kind or the event loop."""

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
    """A few threads for one kind of work that may hang for ever, as on a dead file server."""

    def __init__(self, name: str, threads: int, waiting: int = 100) -> None:
        """`waiting`: largest number of calls that may wait for a free thread."""
        self._pool = ThreadPoolExecutor(threads, f"station {name}")
        self._places = BoundedSemaphore(threads + waiting)

    async def run(self, work: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Run `work` in a thread; return its result. RefusedError where too many calls are waiting."""
        if not self._places.acquire(blocking=False):
            raise RefusedError("busy")
        work_done = self._pool.submit(work, *args, **kwargs)
        work_done.add_done_callback(lambda _: self._places.release())
        return await asyncio.wrap_future(work_done)


MOTION = WorkThreads("motion", 2)
"""Checks of paths"""
DISK = WorkThreads("disk", 3)
"""Files of the session"""
ASKED = WorkThreads("asked", 4, 8)
"""Requests of clients for files and devices"""
WATCH = WorkThreads("watch", 1)
"""Files of which the status tells"""
NAMES = WorkThreads("names", 2)
"""Names of users, which may come from a directory server"""
