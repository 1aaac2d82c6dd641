"""Whether a process belongs to a system service, by its control group.

systemd puts each process that it starts into a group of the unit's name, and each person's login into a scope
of `user.slice`. Nobody but root moves a process from a service's group into a login's. A container or WSL
without systemd, and other ways of starting programs, tell no unit: nothing is known of such a process then.
"""

from __future__ import annotations

import re
from pathlib import Path

_USER_MANAGER = re.compile(r"user@\d+\.service")
"""Starts the programs of one person's desktop and `systemctl --user`: no service of the system."""
_LOGIN = re.compile(r"((serial-|console-|container-)?getty(@.+)?|ssh(d)?(@.+)?)\.service")
"""Services that exist to let persons in: where PAM does not call systemd, their shells stay in the group."""


def system_service(pid: int) -> str:
    """Name the system service that a process belongs to; empty: none, or it is not known."""
    return service_in(_groups(pid))


def innermost_service(pid: int) -> str:
    """Name the innermost service that a process belongs to, also of a user's systemd; empty: none."""
    parts = [part for line in _groups(pid) for part in line.split("/") if part.endswith(".service")]
    return parts[-1] if parts else ""


def _groups(pid: int) -> list[str]:
    """Read the lines of /proc/PID/cgroup; none where the process may not be seen."""
    try:
        return Path(f"/proc/{pid}/cgroup").read_text(errors="replace").splitlines()
    except OSError:
        return []


def service_in(lines: list[str]) -> str:
    """Name the system service in the lines of /proc/PID/cgroup, as cgroups(7) describes them; empty: none.

    Each line is number:controllers:path. systemd keeps its units in the one without controllers (version 2)
    and, where version 1 is mounted, in `name=systemd`.
    """
    for line in lines:
        _, _, named = line.partition(":")
        controllers, _, path = named.partition(":")
        if controllers in ("", "name=systemd") and (service := _service_of(path)):
            return service
    return ""


def _service_of(path: str) -> str:
    """Name the outermost service: below it a service may have groups of its own, of any name."""
    for part in path.split("/"):
        if part.endswith(".service"):
            return "" if _USER_MANAGER.fullmatch(part) or _LOGIN.fullmatch(part) else part
    return ""
