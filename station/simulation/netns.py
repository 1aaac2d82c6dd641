"""Network namespace with only loopback, so that the GigE simulator's broadcasts reach no real network.

``python -m station.simulation.netns COMMAND …`` runs a command inside such a namespace.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import socket
import struct
import sys

from station.cell.errors import StationError

_SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x8913, 0x8914, 0x1


def is_isolated() -> bool:
    """Tell whether this process sees no network interface but `lo`, and that is up."""
    return [name for _, name in socket.if_nameindex()] == ["lo"] and bool(_lo_flags() & _IFF_UP)


def isolated_command(command: list[str]) -> list[str]:
    """Make the command that runs `command` in a new namespace. StationError where `unshare` is missing."""
    unshare = shutil.which("unshare")
    if unshare is None:
        raise StationError("no-unshare")
    # Without root, a user namespace permits making a network namespace.
    rights = [] if os.geteuid() == 0 else ["--map-root-user"]
    return [unshare, *rights, "--net", sys.executable, "-m", "station.simulation.netns", *command]


def bring_lo_up() -> None:
    request = struct.pack("16sh14x", b"lo", _lo_flags() | _IFF_UP)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, _SIOCSIFFLAGS, request)


def _lo_flags() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        answer = fcntl.ioctl(control, _SIOCGIFFLAGS, struct.pack("16sh14x", b"lo", 0))
    return int(struct.unpack("16sh14x", answer)[1])


if __name__ == "__main__":
    bring_lo_up()
    os.execvp(sys.argv[1], sys.argv[1:])
