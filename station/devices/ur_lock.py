"""One owner per arm on this host: an flock that lives as long as the process that holds it."""

from __future__ import annotations

import fcntl
import getpass
import os
import re
import tempfile
import time
from pathlib import Path

from station.errors import RobotError


def lock_folder() -> Path:
    """systemd's runtime folder, the user's, or one under the temporary folder."""
    for variable in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"):
        place = os.environ.get(variable, "").split(":")[0]
        if place and Path(place).is_dir():
            return Path(place)
    return Path(tempfile.gettempdir()) / f"station-{os.getuid()}"


class RobotLock:
    """Held from construction to `release`. Raises RobotError that names the present owner."""

    def __init__(self, name: str, folder: Path | None = None) -> None:
        folder = folder or lock_folder()
        path = folder / f"robot-{re.sub(r'[^A-Za-z0-9.-]', '-', name)[:60]}.lock"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o660)
        except OSError as error:
            raise RobotError(f"cannot open the robot's lock {path}: {error.strerror}") from None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.pread(self._descriptor, 200, 0).decode(errors="replace").strip()
            os.close(self._descriptor)
            raise RobotError(
                f"robot {name} is owned by another station on this host ({owner or 'unknown'}): "
                "use that one, or end it first"
            ) from None
        os.ftruncate(self._descriptor, 0)
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        os.pwrite(self._descriptor, f"pid {os.getpid()}, {_user()}, since {since}\n".encode(), 0)

    def release(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"
