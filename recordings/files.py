"""Safe names, exclusive creation, one writer at a time, nothing half-written."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from recordings.errors import RecordingError, disk_error, exists_error
from recordings.plain_text import bytes_text

MAIN_CAMERA = "main"
"""Name of the camera of a cell that has one, and of folders from before cameras had names.

Here, because programs load an installed calibration without msgspec.
"""
PART_SUFFIX = ".part"
"""Suffix of an unfinished recording; gone once it is finished and on the disk."""
EMPTY_SUFFIX = ".empty"
"""Suffix of a segment that holds nothing; recovery sets it aside."""
LOG_LIMIT_BYTES = 64 * 1024 * 1024
"""No file of lines that only grows is larger."""
ASKED_FOR = 0o666
"""Permissions of a file that somebody asked for: their umask decides."""
_SESSION_NAME = re.compile(r"[a-z0-9-]{1,40}")
_ATTACHMENT_NAME = re.compile(r"[a-z0-9]([a-z0-9_-]|\.(?!\.)){0,39}")


def is_session_name(name: str) -> bool:
    """1…40 of a-z, 0-9 and '-': a folder name on every system, never a path."""
    return _SESSION_NAME.fullmatch(name) is not None


def is_attachment_name(name: str) -> bool:
    """Like `plan.yaml`: at most 40 of a-z, 0-9, '-', '_' and single dots."""
    return _ATTACHMENT_NAME.fullmatch(name) is not None


def session_name_from(text: str) -> str:
    """The nearest safe session name to what a person wrote."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:40] or "session"


def create_exclusively(path: Path) -> int:
    """A new file opened for writing and locked: never an existing file, never through a symlink.

    Returns the descriptor. Raises RecordingError with the remedy.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o640)
    except FileExistsError as error:
        raise exists_error(path) from error
    except OSError as error:
        raise disk_error(
            "create", path, error, "Create its folder first." if error.errno == errno.ENOENT else ""
        ) from error
    lock(descriptor, path)
    return descriptor


def open_regular(path: Path, flags: int = os.O_RDONLY) -> int:
    """Descriptor of whatever a person named or a group member made: it opens at once, or not at all.

    Opening a pipe waits for its other end, and a device may never end. OSError where it is no regular file.
    """
    descriptor = os.open(path, flags | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY, ASKED_FOR)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is a folder, a pipe or a device, not a file", str(path))
    return descriptor


def read_beginning(path: Path, length: int) -> bytes:
    """At most the first `length` bytes of such a file. Raises OSError."""
    with os.fdopen(open_regular(path), "rb") as file:
        return file.read(length)


def read_file(path: Path, limit_bytes: int) -> bytes:
    """The whole content of such a file. OSError, with errno EFBIG where it is larger than `limit_bytes`."""
    content = read_beginning(path, limit_bytes + 1)
    if len(content) > limit_bytes:
        text = f"it is larger than {bytes_text(limit_bytes)}; check that it is the right file"
        raise OSError(errno.EFBIG, text, str(path))
    return content


def open_file(path: Path) -> int:
    """Descriptor of a recording or a bag for reading. RecordingError when it is no readable file."""
    try:
        return open_regular(path)
    except OSError as error:
        if error.errno == errno.EINVAL:
            raise RecordingError("no-file", path=path) from error
        raise disk_error("open", path, error) from error


def lock(descriptor: int, path: Path) -> None:
    """Marks the open file or folder as ours until it is closed. RecordingError when someone else has it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise RecordingError("in-use", path=path) from error


def discard_leftover(path: Path) -> None:
    """Removes what a killed process left half-written. RecordingError when a living one still writes it."""
    try:
        descriptor = open_regular(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:  # nothing there, or nothing of ours: the exclusive creation will tell
        return
    try:
        lock(descriptor, path)
        path.unlink()
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Makes a creation or rename inside the folder survive a power loss."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def rename_new(source: Path, target: Path) -> None:
    """Renames within one folder, durably, and never over something that is there. Raises RecordingError."""
    if os.path.lexists(target):
        raise RecordingError("appeared-meanwhile", path=target, kept_as=source)
    source.rename(target)
    sync_folder(target.parent)


def write_atomically(
    path: Path,
    content: bytes,
    mode: int = 0o640,
    like: Path | None = None,
    check: Callable[[Path], object] | None = None,
) -> None:
    """The file is the old one or the new one, never half, also when several write it or the power fails.

    `mode`: its permissions, less the umask. `like`: a file whose permissions it gets instead, and its owner
    where that is permitted. `check`: reads the new file before it takes the old one's place, and raises what
    keeps the old one there. OSError as it comes; nothing is left beside the file then. A device or a pipe is
    never replaced.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EEXIST, "it exists and is no file", str(path))
    import secrets  # programs that only use a camera need not wait for it

    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        with os.fdopen(descriptor, "wb") as file:
            if like is not None:
                _make_like(descriptor, like.stat())
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if check is not None:
            check(temporary)
        temporary.rename(path)
        sync_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _make_like(descriptor: int, old: os.stat_result) -> None:
    with suppress(PermissionError):
        os.fchown(descriptor, old.st_uid, old.st_gid)
    os.fchmod(descriptor, stat.S_IMODE(old.st_mode))


def require_free_space(folder: Path, reserve_bytes: int) -> int:
    """Free bytes on the folder's disk. Raises RecordingError when they are fewer than the reserve.

    Asked before each pose, so that a pose is never begun that cannot be stored.
    """
    import shutil

    free = shutil.disk_usage(folder).free
    if free < reserve_bytes:
        wanted = reserve_bytes - free
        raise RecordingError(
            "disk-full", folder=folder, free_bytes=free, limit_bytes=reserve_bytes, wanted_bytes=wanted
        )
    return free


def usable_cores() -> int:
    """Count the cores that this process may use; all of them where the system does not say (macOS)."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def state_root(root: Path | str | None = None) -> Path:
    """State folder of the station: `root`, $STATE_DIRECTORY (systemd), or the XDG state folder.

    Raises RecordingError (`no-home`).
    """
    if root is not None:
        return Path(root)
    if state := os.environ.get("STATE_DIRECTORY", "").split(":")[0]:
        return Path(state)
    try:
        base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    except RuntimeError:  # an account of a container: no $HOME, no line in /etc/passwd
        raise RecordingError("no-home") from None
    return Path(base) / "calibration-station"
