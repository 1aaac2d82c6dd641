"""This process before other programs, as far as the system permits."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

DAEMON_NICENESS = -5
"""The arm's watchdog hangs on the daemon's loop and the control process: they go before other programs."""


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
