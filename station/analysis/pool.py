"""Worker process for work that would block the daemon's event loop; replaced when it hangs or dies."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context, parent_process
from typing import TypeVar

from station.cell.errors import StationError
from station.cell.plain import plain_struct
from station.cell.process import die_with_parent

log = logging.getLogger(__name__)

R = TypeVar("R")
START_S = 60.0


class WorkerError(StationError):
    """The worker process died or took too long; it is replaced, its call has no result."""


class Workers:
    """Runs calls in the worker process, one after the other, in order."""

    def __init__(self, initializer: Callable[[], None]) -> None:
        """`initializer` runs first in each new process; its module imports what is needed."""
        self._initializer = initializer
        self._pool: ProcessPoolExecutor | None = None
        self._turn = asyncio.Lock()
        self._closed = False
        self.waiting = 0
        """Number of calls under way; previews are skipped while it is not 0."""

    async def start(self) -> None:
        """Start the worker; return when it has imported what it needs (about a second)."""
        await self.call(os.getpid)

    async def call(
        self, function: Callable[..., R], *args: object, timeout_s: float = 60.0, **named: object
    ) -> R:
        """Return the function's result or raise its exception; WorkerError when the process fails or is late.

        A result that is a message's struct holds plain values only: `plain_struct` has converted them.
        `timeout_s` counts from the start of the call in a ready worker, not from its queueing.
        """
        self.waiting += 1
        try:
            async with self._turn:
                if self._closed:
                    raise WorkerError("station-ending")
                pool = self._pool
                if pool is None:
                    pool = self._pool = ProcessPoolExecutor(
                        1, get_context("spawn"), initializer=self._initializer
                    )
                    await self._ask(pool, START_S, partial(os.getpid))
                return await self._ask(pool, timeout_s, partial(function, *args, **named))
        finally:
            self.waiting -= 1

    async def _ask(self, pool: ProcessPoolExecutor, timeout_s: float, work: partial[R]) -> R:
        died = WorkerError("worker-died", function=work.func.__name__)
        if self._pool is not pool:  # it was closed while the process started
            raise died
        try:
            async with asyncio.timeout(timeout_s):
                return await asyncio.wrap_future(pool.submit(partial(_plainly, work)))
        except asyncio.CancelledError as cancelled:
            self._discard(pool)  # its work would go on, and count as time of the next call
            if _is_being_cancelled():
                raise
            raise died from cancelled  # by the pool, which was closed before it began this work
        except TimeoutError as late:
            self._discard(pool)
            raise WorkerError("worker-late", function=work.func.__name__) from late
        except BrokenProcessPool as broken:
            self._discard(pool)
            raise died from broken

    def close(self) -> None:
        self._closed = True
        if self._pool is not None:
            self._discard(self._pool)

    def _discard(self, pool: ProcessPoolExecutor) -> None:
        if self._pool is pool:
            self._pool = None
        processes = list((pool._processes or {}).values())
        # A frozen worker does not read: the thread that still sends it a large argument would wait for ever.
        if processes and not pool._broken:
            pool._call_queue._reader.close()  # type: ignore[attr-defined]
        # No waiting: the event loop sends the arm's heartbeat. The pool's own thread sees them end.
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()


def _plainly(work: partial[R]) -> R:
    """Run a call in the worker process; what reaches a message is converted before it leaves here."""
    return plain_struct(work())


def _is_being_cancelled() -> bool:
    """Tell whether somebody cancelled the task that runs now."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


def live_with_parent() -> None:
    """Let this process of a pool end with its parent, whatever ends it, and not by Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # at a terminal it reaches all: the parent ends its workers
    if (parent := parent_process()) is not None and parent.pid is not None:
        die_with_parent(parent.pid)
