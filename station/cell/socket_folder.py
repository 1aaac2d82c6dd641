"""Folder of the daemon's sockets, and checks of its owner. Imports little, as `station stop` needs it.

Where other users may write to the folder, they could put a socket there that answers for the daemon.
"""

from __future__ import annotations

import os
import socket
import stat
import struct
from pathlib import Path

ROOT = 0
_CREDENTIALS = struct.Struct("3i")
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class UntrustedFolderError(Exception):
    """Other users could have put the sockets there. Not a StationError, whose import delays STOP by 12 ms."""


def default_socket() -> Path:
    """Choose the socket: where systemd puts it, else the user's own runtime or state folder."""
    if runtime := os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]:
        return Path(runtime) / "control.sock"
    system = Path("/run/station/control.sock")
    try:
        if system.exists():
            return system
    except PermissionError:  # the folder is the operators' alone
        return system
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if runtime and _is_own(Path(runtime)):  # after `su` it may still be the other user's
        return Path(runtime) / "station-control.sock"
    # Unlike Path.home, it does not fail for an account without a home: STOP then says that nothing listens.
    state = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")  # noqa: PTH111
    return Path(state) / "calibration-station" / "run" / "control.sock"


def _is_own(folder: Path) -> bool:
    try:
        return folder.stat().st_uid == os.getuid()
    except OSError:
        return False


def stop_socket(control: Path) -> Path:
    """Return the path of the STOP socket, beside the control socket."""
    return _beside(control, ".stop")


def post_socket(control: Path) -> Path:
    """Return the path of the socket to which an arm's pose is posted, beside the control socket."""
    return _beside(control, ".post")


def post_token(control: Path) -> Path:
    """Return the path of the file with the token of programs that post by TCP (`robot.tcp_port`)."""
    return _beside(control, ".post-token")


def motion_page(control: Path) -> Path:
    """Return the path of the file with STOP and motion state (`protocol.stop_client`)."""
    return _beside(control, ".motion")


def _beside(control: Path, suffix: str) -> Path:
    """Name a file by the whole name of its control socket: two daemons may share a folder."""
    return control.with_name(control.name.removesuffix(".sock") + suffix)


def make_folder(folder: Path) -> None:
    """Create the sockets' folder for this user alone, or accept one that only its owner may write to.

    Raises StationError.
    """
    from station.cell.errors import StationError

    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        owner = folder_owner(folder)
    except OSError as error:
        raise StationError("socket-folder", folder=folder, reason=error.strerror) from None
    except UntrustedFolderError as error:
        raise StationError("untrusted-folder", reason=str(error)) from None
    if owner != os.getuid() and os.getuid() != ROOT:
        raise StationError("untrusted-folder", reason=f"{folder} belongs to {user_name(owner)}")


def folder_owner(folder: Path) -> int:
    """Return the only user, besides root, who can put a socket into a folder.

    This user, root, or an account for which root made the folder. Raises UntrustedFolderError when others
    could have made the folder, or can write to it or to a folder above it.
    """
    try:
        # Not `resolve`: symbolic links on the path must be checked, too.
        return _owner(Path(os.path.realpath(folder)), Path(os.path.abspath(folder)))  # noqa: PTH100
    except OSError as error:
        raise UntrustedFolderError(f"{folder}: {error.strerror}.") from None


def _owner(real: Path, named: Path) -> int:
    for part in (*reversed(named.parents), named):
        if (status := os.lstat(part)) and stat.S_ISLNK(status.st_mode):
            _require(status.st_uid in (ROOT, os.getuid()), part, status.st_uid)
    owner, made_by_root = ROOT, True
    for part in (*reversed(real.parents), real):
        status = os.lstat(part)
        if status.st_uid not in (ROOT, os.getuid(), owner):
            _require(made_by_root, part, status.st_uid)
        owner = status.st_uid
        open_to_others = bool(status.st_mode & _OTHERS_WRITE) and not _own_group_only(status)
        if open_to_others and not (status.st_mode & stat.S_ISVTX and part != real):
            raise UntrustedFolderError(f"{part} can be written to by other users: `chmod go-w {part}`.")
        made_by_root = owner == ROOT and not open_to_others
    return owner


def _require(good: bool, part: Path, owner: int) -> None:
    if not good:
        raise UntrustedFolderError(f"{part} was made by {user_name(owner)}, not by you or the system.")


def _own_group_only(status: os.stat_result) -> bool:
    """Tell whether the folder's group is its owner's private one, to which many systems permit writing."""
    if status.st_mode & stat.S_IWOTH:
        return False
    import grp  # both rarely needed
    import pwd

    try:
        user, group = pwd.getpwuid(status.st_uid), grp.getgrgid(status.st_gid)
    except KeyError:
        return False
    return (
        user.pw_gid == group.gr_gid and set(group.gr_mem) <= {user.pw_name} and user.pw_name == group.gr_name
    )


def bind(link: socket.socket, path: Path) -> None:
    """Bind a Unix socket with mode 0660, or 0600. StationError: it cannot be, and is closed.

    It is the group's only where the folder keeps all others out. Else nobody chose the group: on some systems
    the first group of every user is the same. The umask is that of all threads and tasks, so nothing is
    awaited while it is another.
    """
    from station.cell.errors import StationError

    old = os.umask(0o177 if path.parent.stat().st_mode & stat.S_IRWXO else 0o117)
    try:
        link.bind(str(path))
    except OSError as error:
        link.close()
        raise StationError("socket", path=path, reason=str(error)) from None
    finally:
        os.umask(old)


def peer_of(link: socket.socket) -> tuple[int, int, int]:
    """Ask the kernel for process, user and group at the other end of a Unix socket."""
    pid, uid, gid = _CREDENTIALS.unpack(link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return pid, uid, gid


def way_to_end(link: socket.socket, path: Path) -> str:
    """Say how this user ends the daemon at the other end of a Unix socket; empty: it is another's."""
    import shlex  # rarely needed

    pid, uid, _ = peer_of(link)
    if not pid or uid != os.getuid():
        return ""
    if path == default_socket():
        return ": `station quit`"
    return f": `station quit --socket {shlex.quote(str(path))}`"


def user_name(uid: int) -> str:
    """Return a user's name, or 'uid 1003' when it is unknown."""
    import pwd

    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"uid {uid}"
