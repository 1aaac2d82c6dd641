"""One worker process for everything that would hold up the daemon's loop. It is disposable."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from typing import TypeVar

from station.cell.errors import StationError

log = logging.getLogger(__name__)

R = TypeVar("R")
START_S = 60.0
REAP_S = 5.0


class WorkerError(StationError):
    """The worker died or took too long; it is replaced, and what it was asked is not answered."""


class Workers:
    """Calls run one after the other, in the order they were made."""

    def __init__(self, initializer: Callable[[], None], warm_up: Callable[[], object]) -> None:
        """`initializer` runs in each new process first, then `warm_up`, which loads what is needed."""
        self._initializer, self._warm_up = initializer, warm_up
        self._pool: ProcessPoolExecutor | None = None
        self._turn = asyncio.Lock()
        self._closed = False
        self.waiting = 0
        """Calls under way: a preview is not worth queueing for."""

    async def start(self) -> None:
        """Returns when the worker has loaded what it needs (about a second)."""
        await self.call(self._warm_up)

    async def call(
        self, function: Callable[..., R], *args: object, timeout_s: float = 60.0, **named: object
    ) -> R:
        """The function's result or exception. WorkerError when the process fails or is too slow.

        `timeout_s`: from when its turn comes and the worker is there, so that no call ends another one.
        """
        self.waiting += 1
        try:
            async with self._turn:
                if self._closed:
                    raise WorkerError("The station is ending.", code="station-ending")
                pool = self._pool
                if pool is None:
                    pool = self._pool = ProcessPoolExecutor(
                        1, get_context("spawn"), initializer=self._initializer
                    )
                    await self._ask(pool, START_S, partial(self._warm_up))
                return await self._ask(pool, timeout_s, partial(function, *args, **named))
        finally:
            self.waiting -= 1

    async def _ask(self, pool: ProcessPoolExecutor, timeout_s: float, work: partial[R]) -> R:
        try:
            async with asyncio.timeout(timeout_s):
                return await asyncio.wrap_future(pool.submit(work))
        except (BrokenProcessPool, TimeoutError) as error:
            self._discard(pool)
            late = isinstance(error, TimeoutError)
            text = f"The worker process {'took too long' if late else 'died'} in {work.func.__name__}."
            raise WorkerError(text, code="worker-late" if late else "worker-died") from error

    def close(self) -> None:
        self._closed = True
        if self._pool is not None:
            self._discard(self._pool)

    def _discard(self, pool: ProcessPoolExecutor) -> None:
        if self._pool is pool:
            self._pool = None
        processes = list((pool._processes or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()
        # In a thread: the loop that beats the arm's heart waits for no process to end.
        threading.Thread(target=_reap, args=(processes,), name="worker reaper", daemon=True).start()


def _reap(processes: list[BaseProcess]) -> None:
    for process in processes:
        process.join(REAP_S)
