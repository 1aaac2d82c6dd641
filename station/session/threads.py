"""Separate threads for each kind of blocking work, so that none delays another kind or the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class WorkThreads:
    """A few threads for one kind of work that may hang for ever, as on a dead file server."""

    def __init__(self, name: str, threads: int) -> None:
        self._pool = ThreadPoolExecutor(threads, f"station {name}")

    async def run(self, work: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        return await asyncio.wrap_future(self._pool.submit(work, *args, **kwargs))


MOTION = WorkThreads("motion", 2)
"""Checks of paths"""
DISK = WorkThreads("disk", 3)
"""Files of the session"""
ASKED = WorkThreads("asked", 4)
"""Requests of clients for files and devices; the server bounds their number"""
LATCH = WorkThreads("latch", 1)
"""The file of the latch; one thread, so that what is written last stays"""
WATCH = WorkThreads("watch", 1)
"""Files of which the status tells"""
NAMES = WorkThreads("names", 2)
"""Names of users, which may come from a directory server"""
