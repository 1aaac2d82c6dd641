"""The controller's cycle: due times on a fixed grid of the host's monotonic clock, woken by a timerfd."""

from __future__ import annotations

import asyncio
import ctypes
import os
import time
from collections.abc import Callable

CHUNK = 25
"""Cycles run in one go when behind; sockets are read in between."""
LATE_CYCLES = 4
"""More cycles behind than this: the process was held up, and the cycles count as late."""

_CLOEXEC_NONBLOCK = os.O_CLOEXEC | os.O_NONBLOCK
_ABSOLUTE = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


class Clock:
    """Calls `tick(due_ns, late)` once per cycle, every one of them, in order, none ever skipped."""

    def __init__(self, cycle_s: float, tick: Callable[[int, bool], None]) -> None:
        """cycle_s: in host seconds; differs from the controller's dt by its clock's drift."""
        self._cycle_ns = cycle_s * 1e9
        self._tick = tick
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._fd = -1
        self.start_ns = 0
        """Host time of the controller's time 0."""
        self.count = 0
        self.hold_until_ns = 0
        """No cycle runs before this time; then all that were due run late."""
        self.worst_lateness_ns = 0
        self.late_cycles = 0

    def due_ns(self, cycle: int) -> int:
        return self.start_ns + round(cycle * self._cycle_ns)

    def start(self) -> None:
        self._fd = self._libc.timerfd_create(time.CLOCK_MONOTONIC, _CLOEXEC_NONBLOCK)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create")
        asyncio.get_running_loop().add_reader(self._fd, self._wake)
        self.restart()

    def restart(self) -> None:
        """Controller time begins at 0 again."""
        self.start_ns, self.count = time.monotonic_ns(), 0
        self._arm()

    def stop(self) -> None:
        asyncio.get_running_loop().remove_reader(self._fd)
        os.close(self._fd)

    def _arm(self) -> None:
        at_ns = max(self.due_ns(self.count + 1), self.hold_until_ns)
        spec = _Itimerspec(_Timespec(0, 0), _Timespec(at_ns // 1_000_000_000, at_ns % 1_000_000_000))
        if self._libc.timerfd_settime(self._fd, _ABSOLUTE, ctypes.byref(spec), None) != 0:
            raise OSError(ctypes.get_errno(), "timerfd_settime")

    def _wake(self) -> None:
        try:
            os.read(self._fd, 8)
        except BlockingIOError:
            return
        try:
            self._catch_up(time.monotonic_ns())
        finally:
            self._arm()

    def _catch_up(self, now_ns: int) -> None:
        if now_ns < self.hold_until_ns:
            return
        behind = int((now_ns - self.start_ns) / self._cycle_ns) - self.count
        late = behind > LATE_CYCLES
        for _ in range(min(behind, CHUNK)):
            self.count += 1
            due_ns = self.due_ns(self.count)
            self.worst_lateness_ns = max(self.worst_lateness_ns, now_ns - due_ns)
            self.late_cycles += late
            self._tick(due_ns, late)
