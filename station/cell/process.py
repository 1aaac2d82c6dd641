"""Priority of this process before other programs, as far as the system permits."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
from pathlib import Path

DAEMON_NICENESS = -5
"""The arm's watchdog hangs on the daemon's loop and the control process: they go before other programs."""
_PR_SET_PDEATHSIG = 1


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
