"""Tells systemd how the daemon is (sd_notify): a datagram to the socket it names, nothing without one."""

from __future__ import annotations

import contextlib
import os
import socket


def notify(*lines: str) -> bool:
    """'READY=1', 'WATCHDOG=1', 'STOPPING=1', 'STATUS=…'. False where no systemd listens. Never blocks."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.setblocking(False)
        link.sendto("\n".join(lines).encode(), address)
        return True
    return False


def watchdog_period_s() -> float | None:
    """How often systemd wants to be pinged, twice as often as it checks; None when it does not watch us."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    try:
        limit_s = int(os.environ["WATCHDOG_USEC"]) / 1e6
    except (KeyError, ValueError):
        return None
    return limit_s / 2 if limit_s > 0 else None
