"""Workers for a batch's tasks: processes of this machine, or (`cluster`) the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection
from typing import Protocol, TypeVar

from calibrate.errors import CalibrationError
from recordings.files import usable_cores

_ATTEMPTS = 2
"""A task whose worker died this often is given up."""
T = TypeVar("T")
R = TypeVar("R")


class BatchError(CalibrationError):
    """The batch cannot start or go on; finished results are kept."""

    code = "batch"


@dataclass(frozen=True)
class Lost:
    """A task without an answer."""

    reason: str


class BatchWorkers(Protocol):
    """Calls `work`, a module's own function, with each task; tasks can be hashed and pickled.

    Yields every task once with its answer, as they come, in any order. Closed early, nothing goes on.
    """

    def __call__(self, work: Callable[[T], R], tasks: Sequence[T]) -> Generator[tuple[T, R | Lost]]: ...


def pool(count: int | None = None) -> BatchWorkers:
    """Make workers of `count` processes here (default: one per core). A killed one costs no task."""

    def run(work: Callable[[T], R], tasks: Sequence[T]) -> Generator[tuple[T, R | Lost]]:
        deaths = dict.fromkeys(tasks, 0)
        while deaths:
            # Alone, a task that kills its worker takes no others with it.
            suspect = next((task for task, died in deaths.items() if died), None)
            tried = list(deaths) if suspect is None else [suspect]
            for task, answer in _one_pool(work, tried, count or usable_cores()):
                if isinstance(answer, Lost):
                    deaths[task] += 1
                    if deaths[task] < _ATTEMPTS:
                        continue
                del deaths[task]
                yield task, answer

    return run


def _one_pool(work: Callable[[T], R], tasks: Sequence[T], count: int) -> Iterator[tuple[T, R | Lost]]:
    """Work until all is done or a worker dies: then those under way are lost, and no others begin."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["calibrate.batch.run"])
    theirs, ours = context.Pipe(duplex=False)
    with ours, theirs:
        executor = ProcessPoolExecutor(min(count, len(tasks)), context, _end_with, (theirs,))
        try:
            waiting, whole = iter(tasks), True
            futures: dict[Future[R], T] = {}
            while True:
                with suppress(BrokenProcessPool):
                    for task in islice(waiting, count - len(futures) if whole else 0):
                        futures[executor.submit(work, task)] = task
                if not futures:
                    return
                for future in wait(futures, return_when=FIRST_COMPLETED).done:
                    task = futures.pop(future)
                    try:
                        yield task, future.result()
                    except BrokenProcessPool:
                        whole = False
                        yield task, Lost(f"worker process killed {_ATTEMPTS} times")
        finally:
            ours.close()
            executor.shutdown(cancel_futures=True)


def _end_with(parent: Connection) -> None:
    """End a worker when the parent closes its side of the pipe, as the kernel does for a killed one.

    Ctrl-C is the parent's to answer.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        parent.poll(None)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
