"""Limits on time and memory of one solve: a hostile or broken recording ends in an error.

Nothing is written before a solve is finished, so ending it at any moment leaves what was there before.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import threading
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from types import FrameType, TracebackType

import cv2

from calibrate.errors import CalibrationError

TIME_LIMIT_S = 900.0
MEMORY_LIMIT_MIB = 4096
_GRACE_S = 10.0
"""Python raises the error of the time limit between two of its own instructions, so never inside a long call
of compiled code. After this much more time the process is ended."""


class SolveLimitError(CalibrationError):
    """A solve took more time or memory than it may; nothing was written."""

    code = "solve-limit"


@dataclass(frozen=True)
class Limits:
    """Limits of one solve; 0 = no limit."""

    time_s: float = TIME_LIMIT_S
    memory_mib: int = MEMORY_LIMIT_MIB


def bounded(limits: Limits | None = None) -> AbstractContextManager[None]:
    """Limit the time and memory of a `with` block; beyond them SolveLimitError is raised in it.

    Memory is that of this whole process (its data, not the files it maps). Outside the main thread nothing is
    limited: Python gives signals to the main thread only, and other threads use the same memory.
    """
    if threading.current_thread() is not threading.main_thread():
        return nullcontext()
    return _Bounded(limits or Limits())


class _Bounded(AbstractContextManager[None]):
    """No `@contextmanager`: `_late` must see whether the alarm came inside `__enter__` or `__exit__`."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._late_error = SolveLimitError("time-limit", limit_s=limits.time_s)

    def __enter__(self) -> None:
        if self._limits.time_s > 0:
            self._handler_before = signal.signal(signal.SIGALRM, self._late)
            self._last = threading.Timer(self._limits.time_s + _GRACE_S, self._too_late)
            self._last.daemon = True
            self._last.start()
            # again each second, should an `except` inside the block swallow the first
            signal.setitimer(signal.ITIMER_REAL, self._limits.time_s, 1.0)
        soft, hard = self._memory_before = resource.getrlimit(resource.RLIMIT_DATA)
        if self._limits.memory_mib > 0:
            limit = self._limits.memory_mib * 2**20
            limit = limit if soft == resource.RLIM_INFINITY else min(limit, soft)
            resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._limits.time_s > 0:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._handler_before)
            self._last.cancel()
        resource.setrlimit(resource.RLIMIT_DATA, self._memory_before)
        if problem is not None and problem.__context__ is self._late_error:
            raise self._late_error from None  # code that the alarm interrupted raised another error over it
        if problem is not None and _is_out_of_memory(problem):
            raise SolveLimitError("memory-limit", limit_mib=self._limits.memory_mib) from None

    def _late(self, signal_number: int, frame: FrameType | None) -> None:
        """Raise at the alarm, but not inside `__enter__` or `__exit__`, which must cancel the timer."""
        while frame is not None:
            if frame.f_code in (_Bounded.__enter__.__code__, _Bounded.__exit__.__code__):
                return
            frame = frame.f_back
        raise self._late_error

    def _too_late(self) -> None:
        print(f"calibrate: {self._late_error}", file=sys.stderr, flush=True)
        os._exit(SolveLimitError.exit_code)


def _is_out_of_memory(problem: BaseException) -> bool:
    """Tell the three errors of memory that ran out: Python's, OpenCV's, and of a thread without a stack."""
    if isinstance(problem, cv2.error):
        return bool(problem.code == cv2.Error.StsNoMem)
    thread = isinstance(problem, RuntimeError) and "start new thread" in str(problem)
    return thread or isinstance(problem, MemoryError)
