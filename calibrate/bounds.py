"""Limits on the time and the memory of one solve: a hostile or broken recording ends in a sentence.

Nothing is written before a solve is finished, so ending it at any moment leaves what was there before.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

import cv2

from calibrate.errors import CalibrationError

TIME_LIMIT_S = 900.0
MEMORY_LIMIT_MIB = 4096
_GRACE_S = 10.0
"""Compiled code hears of the time limit only when it returns; after this much more the process ends."""


class SolveLimitError(CalibrationError):
    """A solve took more time or memory than it may; nothing was written."""


@contextmanager
def bounded(time_limit_s: float = TIME_LIMIT_S, memory_limit_mib: int = MEMORY_LIMIT_MIB) -> Iterator[None]:
    """Within the block SolveLimitError is raised once it has taken so long, or so much memory; 0 = no limit.

    Memory is that of this whole process (its data, not the files it maps). Outside the main thread, where no
    signal can be had, only memory is limited.
    """
    try:
        with _time(time_limit_s), _memory(memory_limit_mib):
            yield
    except (MemoryError, RuntimeError, cv2.error) as problem:
        if not _is_out_of_memory(problem):
            raise
        raise SolveLimitError(
            f"The solve needs more than {memory_limit_mib} MiB of memory; nothing was written. Does the "
            "recording hold far more or far larger pictures than you think (recordings info)? More is "
            "allowed with --memory-limit-mib."
        ) from None


def _is_out_of_memory(problem: Exception) -> bool:
    """A thread's stack is memory, too."""
    if isinstance(problem, cv2.error):
        return bool(problem.code == cv2.Error.StsNoMem)
    return isinstance(problem, MemoryError) or "start new thread" in str(problem)


@contextmanager
def _memory(limit_mib: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if limit_mib <= 0:
        yield
        return
    limit = limit_mib * 2**20
    if soft != resource.RLIM_INFINITY:
        limit = min(limit, soft)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


@contextmanager
def _time(limit_s: float) -> Iterator[None]:
    if limit_s <= 0 or threading.current_thread() is not threading.main_thread():
        yield
        return
    text = (
        f"The solve took longer than {limit_s:g} s; nothing was written. Other work on this computer, or a "
        "recording far larger than usual? More is allowed with --time-limit-s."
    )

    def late(signal_number: int, frame: FrameType | None) -> NoReturn:
        raise SolveLimitError(text)

    def too_late() -> None:
        print(f"calibrate: {text}", file=sys.stderr, flush=True)
        os._exit(SolveLimitError.exit_code)

    before = signal.signal(signal.SIGALRM, late)
    last = threading.Timer(limit_s + _GRACE_S, too_late)
    last.daemon = True
    last.start()
    signal.setitimer(signal.ITIMER_REAL, limit_s, 1.0)  # again, should something swallow the first
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        last.cancel()
