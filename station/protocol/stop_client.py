"""STOP as everybody sends it: one datagram. `station stop`, without slow imports, then checks its effect.

From a person to the wire, by files and functions in `station/` (tests/test_pages.py checks that they exist):
  F12: a process between terminal and screen, which draws nothing, sends the datagram b"STOP" at once:
    `tui/stop_key.py:_pass_keys`, `protocol/stop_client.py:send_stop`. Where the screen is not started in the
    foreground of a terminal there is no such process, and the screen alone sends it.
  F12 or a click, by the screen: the datagram again, as it can be clicked, and then the verb "stop" over the
    connection, as a datagram has no answer. A STOP more does no harm. `tui/app.py:StationApp.action_stop`,
    `tui/daemon_link.py:DaemonLink.stop`, `protocol/client.py:Client.call, Client.request, Client.send_stop`.
  `station stop`: the datagram, then it watches the motion page (below) until the arm rests.
    `cli/__init__.py:main`, `protocol/stop_client.py:main, stop_and_tell, stop, _send_and_watch, send_stop`.
  In the daemon: approval and run end, the state is STOPPED, the arm is stopped.
    `server/stop_server.py:StopServer._woken, _read, _carry_out`,
    `server/dispatch.py:SessionDispatcher.stop_by_datagram, _to_the_end` (a task of the event loop, which
    begins at its next turn), `session/session.py:Session.stop, _halt, _stop_arm`,
    `devices/ur/robot.py:UrRobot.stop, StopPaths.stop`. The socket is also read at the beginning of every
    round of the session: `session/supervisor.py:SessionSupervisor._round`,
    `server/stop_server.py:StopServer.round`.
  From there by two ways, one right after the other; neither waits for an answer of the other:
    The control process: {"do": "stop", "deceleration": 4.0} on its socket, rad/s²; it calls stopJ(4.0) of
      ur_rtde, or of the station's own script, which gets an RTDE data packet (type "U") with the command
      STOP: stopj(4.0) where it moves, then halt. `devices/ur/child.py:ControlChild.stop, _send`,
      `devices/ur/control.py:MotionServer.serve`, `devices/ur/script.py:ScriptControl.stopJ, _write`,
      `devices/rtde.py:Recipe.pack`.
    The robot's dashboard: b"stop\\n" to port 29999, also where the station has no control.
      `devices/ur/dashboard.py:Dashboard.send`.
  Where the dashboard does not answer "Stopped" within 50 ms it is asked once more, on a new connection. The
    control process is killed once it answered, at most 0.1 s after STOP; a program that it left playing is
    stopped.
    `devices/ur/robot.py:StopPaths._finish_stop, _dashboard_stop_anew, stop_leftover_program`.
  Where the daemon hangs, no way above is left. Its session beats no more, the control process resets the
    watchdog of the program at the controller only for a beat of the last 0.1 s, and 0.2 s after the last one
    the watchdog stops the arm (decision 0045).
    `session/supervisor.py:SessionSupervisor._round`, `devices/ur/control.py:MotionServer._beat`.
  The same from the function named: the verb, `server/connections.py:_take`; Ctrl-C at a command,
    `cli/session.py:attended`; signals to the daemon, `daemon.py:Daemon.end`; a client in control that is
    gone, `server/dispatch.py:SessionDispatcher.gone`.
  F12 in `station new`: no daemon runs yet, the dashboard alone. `tui/new_cell.py:NewCell.action_stop`,
    `devices/ur/guided_arm.py:GuidedArm.stop`, `devices/ur/dashboard.py:Dashboard.ask`.

STOP is sent to whatever listens on the socket. It is reported as done only if the genuine daemon says so on
the motion page, a small file beside the socket that only the daemon's user can have made. It tells how many
STOPs were carried out, and whether the arm rests. A file is used because other users could delay answers by
filling a queue.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import struct
import sys
import time
from collections.abc import Sequence
from enum import Enum, IntEnum
from pathlib import Path
from typing import NamedTuple

from station.cell.socket_folder import (
    ROOT,
    UntrustedFolderError,
    default_socket,
    folder_owner,
    motion_page,
    stop_socket,
)

_MAGIC = b"STATION1"
_LAYOUT = struct.Struct("<8sIIQ")
HEARD_S = 0.8
"""Longest wait for a confirmation, as the person may need the emergency stop."""
REST_S = 3.0
_LOOK_S = 0.005


class ArmMotion(IntEnum):
    """What the newest state of the robot says."""

    UNKNOWN = 0
    """No current state from the robot"""
    MOVES = 1
    RESTS = 2


class Page(NamedTuple):
    pid: int
    motion: ArmMotion
    stops: int
    """Number of STOPs carried out since the daemon's start."""


def packed(page: Page) -> bytes:
    return _LAYOUT.pack(_MAGIC, page.pid, page.motion, page.stops)


def create_page(path: Path, page: Page) -> int:
    """Create the motion page, readable by the group; return its descriptor. Raises OSError."""
    path.unlink(missing_ok=True)
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(path, flags, 0o640)
    os.fchmod(descriptor, 0o640)  # independent of the umask
    write_page(descriptor, page)
    return descriptor


def write_page(descriptor: int, page: Page) -> None:
    """Write the page in one call; a disk that is full or stuck may refuse it or take long. Raises OSError."""
    os.pwrite(descriptor, packed(page), 0)


def open_page(path: Path, owners: set[int]) -> int:
    """Open the motion page for reading. PermissionError where its owner is not in `owners`, OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_uid not in owners:
        os.close(descriptor)
        raise PermissionError(1, "not the daemon's", str(path))
    return descriptor


def read_page(descriptor: int | None) -> Page | None:
    """Read the motion page; None when there is none, or it is incomplete."""
    if descriptor is None:
        return None
    raw = os.pread(descriptor, _LAYOUT.size, 0)
    if len(raw) != _LAYOUT.size or raw != os.pread(descriptor, _LAYOUT.size, 0):  # just being written
        return None
    magic, pid, motion, stops = _LAYOUT.unpack(raw)
    if magic != _MAGIC or motion not in ArmMotion._value2member_map_:
        return None
    return Page(pid, ArmMotion(motion), stops)


class Outcome(Enum):
    """Result of a STOP."""

    RESTS = "stopped, the arm rests; latched: look at the cell, then `station acknowledge`"
    MOVES = "STOP was heard, but the arm still moves. Press the emergency stop."
    UNKNOWN = (
        "STOP is latched, but the robot does not tell whether it moves. If it does, press its emergency stop."
    )
    SILENT = "STOP was sent, but the station did not confirm it. Press the emergency stop."
    NO_DAEMON = "STOP reached nobody: press the emergency stop. No station serves {socket}."
    DENIED = "STOP reached nobody: press the emergency stop. {socket} is for the group station-operator."
    UNTRUSTED = "{reason} Whatever answers there may not be the station. Press the emergency stop."

    def told(self, control: Path, reason: str = "") -> str:
        """Words for people; `reason`: why it is UNTRUSTED."""
        return self.value.format(socket=control, reason=reason)


def main(arguments: Sequence[str]) -> int | None:
    """Run `station stop`; return the exit code, 0 only when the arm rests. None: not for this program."""
    others = [word for word in arguments if word != "--json"]
    match others:
        case []:
            control = default_socket()
        case ["--socket", path] if not path.startswith("-"):
            control = Path(path)
        case _:
            return None
    return stop_and_tell(control, as_json=len(others) < len(arguments))


def stop_and_tell(control: Path, as_json: bool = False) -> int:
    """Send STOP and say what became of it; return the exit code, 0 only when the arm rests."""
    outcome, reason = stop(control)
    good = outcome is Outcome.RESTS
    words = outcome.told(control, reason)
    if as_json:
        import json  # only now that STOP was sent

        print(json.dumps({"outcome": outcome.name.lower().replace("_", "-"), "text": words}))
        return 0 if good else 1
    print(words if good else f"station: {words}", file=sys.stdout if good else sys.stderr)
    return 0 if good else 1


def send_stop(control: Path) -> Outcome | None:
    """Send STOP without waiting for its effect; None: it was sent, else why it was not."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
            link.setblocking(False)
            link.connect(str(stop_socket(control)))
            with contextlib.suppress(BlockingIOError):
                # A full queue holds nothing but STOPs, so the daemon stops the arm anyway.
                link.send(b"STOP")
    except (FileNotFoundError, ConnectionRefusedError):
        return Outcome.NO_DAEMON
    except PermissionError:
        return Outcome.DENIED
    except OSError:  # a name too long, another kind of socket
        return Outcome.SILENT
    return None


def stop(control: Path) -> tuple[Outcome, str]:
    """Send STOP and check that the genuine daemon carried it out; return the outcome, and why UNTRUSTED."""
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
    except OSError as error:
        if error.errno not in (errno.ENOENT, errno.EACCES):
            send_stop(control)
            return Outcome.UNTRUSTED, f"{error.filename}: {error.strerror}."
        page = None
    try:
        return _send_and_watch(control, page), ""
    finally:
        if page is not None:
            os.close(page)


def _send_and_watch(control: Path, page: int | None) -> Outcome:
    give_up_s = time.monotonic() + HEARD_S
    before = read_page(page)
    if (unsent := send_stop(control)) is not None:
        return unsent
    while page is not None and time.monotonic() < give_up_s:
        now = read_page(page)
        if before is not None and now is not None and now.stops > before.stops:
            return _until_rest(page)
        before = before or now
        time.sleep(_LOOK_S)
    return Outcome.SILENT


def _until_rest(page: int) -> Outcome:
    give_up_s = time.monotonic() + REST_S
    motion = ArmMotion.UNKNOWN
    while time.monotonic() < give_up_s:
        if (now := read_page(page)) is not None:
            motion = now.motion
            if motion is ArmMotion.RESTS:
                return Outcome.RESTS
        time.sleep(_LOOK_S)
    return Outcome.MOVES if motion is ArmMotion.MOVES else Outcome.UNKNOWN
