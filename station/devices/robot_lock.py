"""Lock of a robot for one station on this computer, whatever their state folders.

Where the service is installed, systemd made a folder that only members of `station-operator` can enter: who
may make an arm move. There the lock is a file's, which nobody else can hold or touch. Elsewhere it is the
name of an abstract Unix socket, which any user may take first. Beside the file the name is taken, too, so
that a daemon which does not see the folder is noticed: of an earlier version, or in a container with this
computer's network.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import grp
import logging
import os
import pwd
import re
import socket
from pathlib import Path

from recordings.files import open_regular
from station.cell.errors import RobotError
from station.cell.socket_folder import ROOT, peer_of, user_name

log = logging.getLogger(__name__)

LOCKS = Path("/run/station-robots")
"""Made by systemd (`station.tmpfiles`)."""
_OWNER_BYTES = 200
_ATTEMPTS = 3


class RobotLock:
    """Lock of a robot, held from construction to `release`, or to the end of the process.

    `folder`: of lock files; None, or one that is not there: only the socket's name locks.
    Raises RobotError that names the present owner.
    """

    def __init__(self, name: str, folder: Path | None = LOCKS) -> None:
        plain = re.sub(r"[^A-Za-z0-9.-]", "-", name)[:60]
        self._file = -1
        self._socket: socket.socket | None = None
        guarded = folder is not None and folder.is_dir()
        if folder is not None and guarded:
            self._file = _locked_file(name, folder / plain)
        try:
            self._socket = _bound(name, f"\0calibration-station/robot/{plain}", folder if guarded else None)
        except RobotError:
            self.release()
            raise

    def release(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def _locked_file(robot: str, path: Path) -> int:
    """Lock a robot's file and write the owner's name into it; return its descriptor. Raises RobotError."""
    try:
        descriptor = _opened(path)
    except OSError as error:
        raise RobotError("robot-lock", robot=robot, folder=path.parent, reason=str(error)) from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        owner = os.pread(descriptor, _OWNER_BYTES, 0).decode(errors="replace")
        os.close(descriptor)
        raise RobotError("robot-owned", robot=robot, owner=owner or "unknown") from None
    with contextlib.suppress(OSError):  # the lock counts; the name is for people
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"pid {os.getpid()}, {user_name(os.getuid())}".encode(), 0)
    return descriptor


def _opened(path: Path) -> int:
    """Open a lock file, made by whichever member came first, for all of them. Raises OSError."""
    for _ in range(_ATTEMPTS):
        # Not O_CREAT alone: in a sticky folder the kernel refuses it for a file of another user.
        with contextlib.suppress(FileNotFoundError):
            return open_regular(path, os.O_RDWR | os.O_NOFOLLOW)
        with contextlib.suppress(FileExistsError):
            descriptor = open_regular(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CREAT | os.O_EXCL)
            os.fchmod(descriptor, 0o660)
            return descriptor
    raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))


def _bound(robot: str, address: str, folder: Path | None) -> socket.socket | None:
    """Take an abstract socket's name. RobotError where another station has it.

    `folder`: of lock files, which closes out all but its group. Then who is not in that group, or does not
    listen as a station does, has the name only to keep others out, and None is returned.
    """
    held = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        held.bind(address)
        held.listen(1)
    except OSError as error:
        held.close()
        pid, uid = _owner(address)
        owner = f"pid {pid}, {user_name(uid)}" if pid else str(error)
        if folder is None or (pid and _is_member(uid, folder.stat().st_gid)):
            raise RobotError("robot-owned", robot=robot, owner=owner) from None
        log.warning("the name of robot %s's lock is held by a stranger, which counts not: %s", robot, owner)
        return None
    return held


def _owner(address: str) -> tuple[int, int]:
    """Ask the kernel for process and user of a lock's owner; zeros when it is gone or does not listen."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.setblocking(False)
        try:
            link.connect(address)
        except OSError:
            return 0, 0
        pid, uid, _ = peer_of(link)
    return pid, uid


def _is_member(uid: int, gid: int) -> bool:
    """Tell whether a user may enter a folder of this group; a user whom nobody knows may not."""
    if uid in (ROOT, os.getuid()):
        return True
    try:
        user = pwd.getpwuid(uid)
        return user.pw_gid == gid or user.pw_name in grp.getgrgid(gid).gr_mem
    except KeyError:
        return False
