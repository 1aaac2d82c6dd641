"""`station stop` without the command line's libraries: one datagram, then a look at what became of it.

STOP is sent wherever something listens; that it worked is claimed only when the genuine daemon says so.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time
from collections.abc import Sequence
from enum import Enum
from pathlib import Path

from station.cell.socket_folder import (
    ROOT,
    UntrustedFolderError,
    default_socket,
    folder_owner,
    motion_page,
    stop_socket,
)
from station.protocol.motion_page import Motion, Page, open_page, read_page

HEARD_S = 0.8
"""A person at the emergency stop waits no longer for an answer."""
REST_S = 3.0
_LOOK_S = 0.005


class Outcome(Enum):
    """What became of a STOP."""

    RESTS = "stopped, the arm rests; latched: look at the cell, then `station acknowledge`"
    MOVES = "STOP was heard, but the arm still moves. Press the emergency stop."
    UNKNOWN = "STOP is latched, but the robot tells no state. Look at the arm, then `station doctor`."
    SILENT = "STOP was sent, but the station did not confirm it. Press the emergency stop."
    NO_DAEMON = "No station daemon serves {socket}: STOP reached nobody. Press the emergency stop."
    DENIED = "{socket}: not allowed (group station-operator is). Press the emergency stop."
    UNTRUSTED = "{reason} Whatever answers there may not be the station. Press the emergency stop."


def main(arguments: Sequence[str]) -> int | None:
    """The exit code: 0 only when the arm rests. None for arguments that are the full command line's."""
    match list(arguments):
        case []:
            control = default_socket()
        case ["--socket", path] if not path.startswith("-"):
            control = Path(path)
        case _:
            return None
    return stop_and_tell(control)


def stop_and_tell(control: Path) -> int:
    outcome, reason = stop(control)
    good = outcome is Outcome.RESTS
    words = outcome.value.format(socket=control, reason=reason)
    print(words if good else f"station: {words}", file=sys.stdout if good else sys.stderr)
    return 0 if good else 1


def send_stop(control: Path) -> bool:
    """Puts one STOP into the daemon's queue without waiting for what comes of it; False: not queued."""
    try:
        with _link(control) as link:
            link.send(b"STOP")
    except OSError:
        return False
    return True


def stop(control: Path) -> tuple[Outcome, str]:
    """Sends STOP, and looks whether the genuine daemon heard it and the arm rests; why it is UNTRUSTED."""
    try:
        owners = {folder_owner(control.parent), ROOT}
    except UntrustedFolderError as error:
        send_stop(control)
        missing = not stop_socket(control).exists()
        return (
            (Outcome.NO_DAEMON, "") if missing and not control.exists() else (Outcome.UNTRUSTED, str(error))
        )
    try:
        page = open_page(motion_page(control), owners)
    except FileNotFoundError:
        page = None
    except OSError as error:
        send_stop(control)
        return Outcome.UNTRUSTED, f"{error.filename}: {error.strerror}."
    try:
        return _stop(control, page), ""
    finally:
        if page is not None:
            os.close(page)


def _stop(control: Path, page: int | None) -> Outcome:
    give_up_s = time.monotonic() + HEARD_S
    before = _page(page)
    try:
        with _link(control) as link, contextlib.suppress(BlockingIOError):
            # A full queue is full of STOPs: the daemon stops the arm all the same.
            link.send(b"STOP")
    except (FileNotFoundError, ConnectionRefusedError):
        return Outcome.NO_DAEMON
    except PermissionError:
        return Outcome.DENIED
    while page is not None and time.monotonic() < give_up_s:
        now = read_page(page)
        if before is not None and now is not None and now.stops > before.stops:
            return _until_rest(page)
        before = before or now
        time.sleep(_LOOK_S)
    return Outcome.SILENT


def _link(control: Path) -> socket.socket:
    link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        link.setblocking(False)
        link.connect(str(stop_socket(control)))
    except OSError:
        link.close()
        raise
    return link


def _page(descriptor: int | None) -> Page | None:
    return read_page(descriptor) if descriptor is not None else None


def _until_rest(page: int) -> Outcome:
    give_up_s = time.monotonic() + REST_S
    motion = Motion.UNKNOWN
    while time.monotonic() < give_up_s:
        if (now := read_page(page)) is not None:
            motion = now.motion
            if motion is Motion.RESTS:
                return Outcome.RESTS
        time.sleep(_LOOK_S)
    return Outcome.MOVES if motion is Motion.MOVES else Outcome.UNKNOWN
