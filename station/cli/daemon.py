"""The operator screen (`station tui`), and the daemon of a command: one that serves already, or a new one."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from socket import AF_UNIX
from socket import socket as connection

from recordings.files import state_root
from station.cell.child import ChildProcess, start_child
from station.cell.errors import StationError
from station.cell.socket_folder import default_socket, peer_of, way_to_end
from station.cli.console import Socket, require_terminal
from station.protocol.client import DaemonGoneError, ask
from station.protocol.verbs import GetPlan

READY_S = 120.0
"""It took 70 s on a computer at load 14. A daemon that ends says so at once."""
END_S = 60.0


def user_config() -> Path:
    """Where `station` looks for the user's configuration."""
    home = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")  # noqa: PTH111  (never fails)
    return Path(home) / "calibration-station" / "station.yaml"


def find_config() -> Path | None:
    """$STATION_CONFIG, the user's, or the system's; None where there is none."""
    if named := os.environ.get("STATION_CONFIG"):
        return Path(named)  # also where it is missing: another cell than the named one is never served
    return next((p for p in (user_config(), Path("/etc/station/station.yaml")) if p.is_file()), None)


def ensure_daemon(socket: Path) -> Path:
    """The socket of a daemon that answers; starts one where none does. StationError when that fails."""
    if not answers(socket):
        start_daemon(socket, find_config())
    return socket


def start_daemon(socket: Path, config: Path | None) -> None:
    """Start a daemon that goes on without this program. StationError when it cannot, as where one serves.

    `config`: the cell to serve; None: a simulated one.
    """
    what = ["--simulate"] if config is None else ["--config", str(config)]
    cell = "a SIMULATED cell (none set up: `station new`)" if config is None else f"the cell of {config}"
    print(f"Starting {cell} …", file=sys.stderr)
    _started([*what, "--socket", str(socket)], state_root() / "daemon.log", subprocess.DEVNULL)


@contextmanager
def own_daemon(arguments: Sequence[str], log: Path) -> Iterator[Path]:
    """`station serve ARGUMENTS` as a child; its socket. It ends with the block, or with this process.

    StationError when it does not start.
    """
    with tempfile.TemporaryDirectory(prefix="station-") as place:
        socket = Path(place) / "control.sock"
        child = _started([*arguments, "--socket", str(socket), "--end-with-stdin"], log, subprocess.PIPE)
        try:
            yield socket
        finally:
            child.stop(END_S)


def _started(arguments: Sequence[str], log: Path, stdin: int) -> ChildProcess:
    """Start a daemon and wait until it serves. StationError with the end of what it said."""
    command = [sys.executable, "-m", "station.cli", "serve", *arguments]
    return start_child("daemon", command, READY_S, log, stdin)


def tell_what_goes_on(socket: Path) -> None:
    """Tell a person who closed the screen that the daemon goes on, and how to end it."""
    with connection(AF_UNIX) as link:
        if link.connect_ex(str(socket)) == 0:
            end = f" End it{how}." if (how := way_to_end(link, socket)) else ""
            print(f"The station goes on without this screen. `station` opens it again.{end}")


class DaemonProcess:
    """Process of the daemon at the other end of a socket, to be waited for."""

    def __init__(self, link: connection, pid: int, process: int | None) -> None:
        self.pid = pid
        self._link, self._process = link, process
        """Connection to it; descriptor of the process, None: it is not seen from here, as in a container."""

    def ended(self, wait_s: float) -> bool:
        """Wait until it has ended, or at least closed its socket; False where it has not in this time."""
        if self._process is not None:
            return bool(select.select([self._process], [], [], max(wait_s, 0.0))[0])
        give_up_s = time.monotonic() + wait_s
        while (left_s := give_up_s - time.monotonic()) > 0:
            self._link.settimeout(left_s)
            try:
                if not self._link.recv(4096):
                    return True
            except TimeoutError:
                break
            except OSError:
                return True
        return False


@contextmanager
def daemon_process(socket: Path) -> Iterator[DaemonProcess]:
    """Find the process that serves a socket, before it is asked to end. DaemonGoneError where none does."""
    with connection(AF_UNIX) as link:
        try:
            link.connect(str(socket))
        except (FileNotFoundError, ConnectionRefusedError):
            raise DaemonGoneError(path=socket) from None
        except PermissionError:
            raise DaemonGoneError("not-allowed", path=socket) from None
        pid = peer_of(link)[0]
        process = None
        with suppress(OSError):
            process = os.pidfd_open(pid)
        try:
            yield DaemonProcess(link, pid, process)
        finally:
            if process is not None:
                os.close(process)


def answers(socket: Path) -> bool:
    try:
        ask(socket, GetPlan())
    except StationError as problem:
        if problem.code == "not-allowed":  # somebody else's daemon serves there
            raise
        return not isinstance(problem, DaemonGoneError)
    return True


def tui_command(socket: Socket = None) -> None:
    """Open the operator screen; start a daemon if none runs.

    The daemon gets a simulated cell where there is no configuration. With --socket none is started: the
    screen waits for the one that serves there.
    """
    require_terminal("The operator screen", "Without one use `station capture` or `station demo`.")
    from station.tui.app import run

    # A socket that is named belongs to somebody: on a cell's console a second daemon would be a wrong one.
    served = socket or ensure_daemon(default_socket())
    run(served)
    tell_what_goes_on(served)
