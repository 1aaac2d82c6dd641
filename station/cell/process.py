"""Priority and pauses of the station's processes, as far as the system permits."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import logging
import os
import resource
import signal
import threading
import time
from pathlib import Path

log = logging.getLogger(__name__)

DAEMON_NICENESS = -5
"""Niceness of daemon and control process, whose delay would let the arm's watchdog stop it."""
DAEMON_PRIORITY, CONTROL_PRIORITY = 10, 11
"""Real-time priorities (1 to 99), where permitted; higher for the control process than the daemon."""
REAL_TIME_LIMIT_US = 500_000, 2_000_000
"""Computing time without a pause after which a thread gives up real-time priority, and is killed."""
GRANT_REAL_TIME = "'@station-operator - rtprio 20' in /etc/security/limits.d/station.conf, then log in again"
SWEEP_S = 1.0
_PR_SET_PDEATHSIG = 1
_LOCK_PAGES_IN_USE = 1 | 2 | 4
"""MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT: pages once used stay in memory."""


def freeze_startup() -> None:
    """Exclude what was loaded from garbage collection, whose pauses (~100 ms) delay heartbeat and STOP."""
    gc.collect()
    gc.freeze()


def die_with_parent(parent_pid: int) -> None:
    """Make the kernel kill this process when the thread that started it ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:  # the parent died before the line above
        os._exit(1)


def go_before_others(niceness: int) -> None:
    """Set this niceness, or keep a lower one; without permission nothing changes.

    Where Linux groups processes by session (autogroup), niceness counts only within the group. There the
    leader of a session sets that of its group.
    """
    with contextlib.suppress(OSError):
        wanted = min(niceness, os.getpriority(os.PRIO_PROCESS, 0))
        os.setpriority(os.PRIO_PROCESS, 0, wanted)
        if os.getsid(0) == os.getpid():  # only a session of its own, not a shell's or terminal's
            Path("/proc/self/autogroup").write_text(str(wanted))


def control_in_real_time() -> None:
    """Set real-time priority for the control process: this thread and those it starts, where permitted."""
    with contextlib.suppress(OSError):
        if real_time_granted(CONTROL_PRIORITY):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(CONTROL_PRIORITY))


def real_time_granted(priority: int = DAEMON_PRIORITY) -> bool:
    """Tell by the resource limit whether real-time priority is permitted.

    The rights of root do not count: real time must be granted on purpose.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    return limit == resource.RLIM_INFINITY or limit >= priority


def in_real_time() -> bool:
    """Tell whether this thread has real-time priority."""
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR


def give_own_priority(pid: int) -> None:
    """Give a child process this one's priority, so that a simulated controller answers as fast as a robot."""
    with contextlib.suppress(OSError):
        niceness = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, pid, niceness)
        Path(f"/proc/{pid}/autogroup").write_text(str(niceness))
    with contextlib.suppress(OSError):
        if in_real_time():
            os.sched_setscheduler(pid, os.SCHED_RR, os.sched_getparam(0))


class RealTimeThreads:
    """Real-time priority for all threads of this process, as they share one interpreter lock.

    Child processes do not get it. If one thread computes too long without a pause, all lose it.
    """

    def __init__(self) -> None:
        """Call in the main thread. Does nothing, now and later, where real time is not permitted."""
        self._known: set[str] = set()
        self._count, self._due_s = 0, 0.0
        self.granted = hasattr(os, "sched_setscheduler") and real_time_granted()
        if self.granted:
            signal.signal(signal.SIGXCPU, lambda *_: self._give_up())
            with contextlib.suppress(OSError, ValueError):
                resource.setrlimit(resource.RLIMIT_RTTIME, REAL_TIME_LIMIT_US)
            if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY:
                ctypes.CDLL(None).mlockall(_LOCK_PAGES_IN_USE)
            self.sweep()

    def sweep(self) -> None:
        """Set the priority of new threads; call often."""
        now_s, count = time.monotonic(), threading.active_count()
        if not self.granted or (count == self._count and now_s < self._due_s):
            return
        self._count, self._due_s = count, now_s + SWEEP_S
        threads = _threads()
        for thread in threads - self._known:
            self._schedule(thread, os.SCHED_RR | os.SCHED_RESET_ON_FORK, DAEMON_PRIORITY)
        self._known = threads

    def _give_up(self) -> None:
        self.granted = False
        for thread in _threads():
            self._schedule(thread, os.SCHED_OTHER, 0)
        log.warning("a thread computed for too long: real-time scheduling is given up")

    def _schedule(self, thread: str, policy: int, priority: int) -> None:
        try:
            os.sched_setscheduler(int(thread), policy, os.sched_param(priority))
        except ProcessLookupError:
            pass
        except OSError:
            self.granted = False


def _threads() -> set[str]:
    return {place.name for place in Path("/proc/self/task").iterdir()}
