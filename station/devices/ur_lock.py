"""One owner per arm for all users of this computer: an abstract socket that lives as long as its process.

A lock file would lie in some user's folder, and another user would have another one. The kernel tells who
holds the socket, so the refusal can name them.
"""

from __future__ import annotations

import re
import socket
import struct

from station.cell.errors import RobotError
from station.cell.socket_folder import user_name


class RobotLock:
    """Held from construction to `release`. Raises RobotError that names the present owner."""

    def __init__(self, name: str) -> None:
        address = f"\0calibration-station/robot/{re.sub(r'[^A-Za-z0-9.-]', '-', name)[:60]}"
        self._held = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._held.bind(address)
            self._held.listen(1)
        except OSError as error:
            self._held.close()
            raise RobotError(
                f"robot {name} is owned by another station on this computer ({_owner(address) or error}): "
                "use that one, or end it first"
            ) from None

    def release(self) -> None:
        self._held.close()


def _owner(address: str) -> str:
    """'pid 4711, anna'; empty when it is gone already, or does not listen."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.setblocking(False)
        try:
            link.connect(address)
        except OSError:
            return ""
        pid, uid, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return f"pid {pid}, {user_name(uid)}"
