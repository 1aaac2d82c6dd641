"""Priority of this process before other programs, as far as the system permits."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import resource
import signal
import threading
import time
from pathlib import Path

log = logging.getLogger(__name__)

DAEMON_NICENESS = -5
"""The arm's watchdog hangs on the daemon's loop and the control process: they go before other programs."""
DAEMON_PRIORITY, CONTROL_PRIORITY = 10, 11
"""Real time (1 to 99), where it is granted. The control process never waits for the daemon."""
REAL_TIME_LIMIT_US = 500_000, 2_000_000
"""A thread that computes for so long without a pause gives real time up, and is killed."""
GRANT_REAL_TIME = "'@station-operator - rtprio 20' in /etc/security/limits.d/station.conf, then log in again"
SWEEP_S = 1.0
_PR_SET_PDEATHSIG = 1
_LOCK_PAGES_IN_USE = 1 | 2 | 4
"""MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT: what was touched once stays in memory."""


def waited_share(pressure: Path = Path("/proc/pressure/cpu")) -> float:
    """Share of the last 10 s, 0…1, in which programs waited for a processor (Linux's PSI); 0: not known."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return float(pressure.read_text().split("avg10=")[1].split()[0]) / 100
    return 0.0


def die_with_parent(parent_pid: int) -> None:
    """Has the kernel kill this process when the thread that started it ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:  # it died before the line above
        os._exit(1)


def go_before_others(niceness: int, autogroup: Path = Path("/proc/self/autogroup")) -> None:
    """Asks for this niceness, or keeps a lower one; who may not goes on as before.

    Where Linux groups processes by session (autogroup), niceness counts only inside the group: the leader of
    a session asks for its whole group.
    """
    with contextlib.suppress(OSError):
        wanted = min(niceness, os.getpriority(os.PRIO_PROCESS, 0))
        os.setpriority(os.PRIO_PROCESS, 0, wanted)
        if os.getsid(0) == os.getpid():  # not a shell's session, nor a terminal's
            autogroup.write_text(str(wanted))


def control_in_real_time() -> None:
    """Real time for this thread and those that it starts, where it is granted: for the control process."""
    with contextlib.suppress(OSError):
        if real_time_granted(CONTROL_PRIORITY):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(CONTROL_PRIORITY))


def real_time_granted(priority: int = DAEMON_PRIORITY) -> bool:
    """The limit says so. Not the rights of root: who starts a daemon in a root shell did not mean it."""
    limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    return limit == resource.RLIM_INFINITY or limit >= priority


def in_real_time() -> bool:
    """This thread is."""
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR


def give_own_priority(pid: int) -> None:
    """Gives a process that was just started this one's: a simulated controller's gaps are no robot's."""
    with contextlib.suppress(OSError):
        niceness = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, pid, niceness)
        Path(f"/proc/{pid}/autogroup").write_text(str(niceness))
    with contextlib.suppress(OSError):
        if in_real_time():
            os.sched_setscheduler(pid, os.SCHED_RR, os.sched_getparam(0))


class RealTimeThreads:
    """Real time for all threads of this process or none: they share one interpreter lock.

    Not for the processes that it starts. A thread that computes without a pause ends it for all.
    """

    def __init__(self) -> None:
        """In the main thread. Where it is not granted nothing happens, here and later."""
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
        """Called often: gives it to the threads that are new."""
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
