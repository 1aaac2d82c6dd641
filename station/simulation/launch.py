"""Starts a simulated controller as a child process on a free loopback address."""

from __future__ import annotations

import json
import os
import random
import selectors
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from station.cell.errors import CameraError, RobotError
from station.simulation.netns import is_isolated

ATTEMPTS = 5
ADDRESS_TAKEN = 1
"""Exit code of a controller that cannot listen on its address."""
STOP_TIMEOUT_S = 3.0
END_TIMEOUT_S = 0.5
PORT = 29990
_STOP_TIMEOUT_S = 3.0


class AdminClient:
    """One connection; blocking, with a timeout on every call. Not for use from two threads at once."""

    def __init__(self, host: str, timeout_s: float = 5.0) -> None:
        """Raises RobotError when nothing listens there."""
        self.host = host
        try:
            self._socket = socket.create_connection((host, PORT), timeout_s)
        except OSError as error:
            raise RobotError(f"no simulated controller answers on {host}:{PORT} ({error})") from error
        self._lines = self._socket.makefile("rb")

    def ask(self, cmd: str, **arguments: Any) -> dict[str, Any]:
        """The answer's fields. Raises RobotError when the command is refused or the simulation is gone."""
        try:
            self._socket.sendall(json.dumps({"cmd": cmd, **arguments}).encode() + b"\n")
            line = self._lines.readline()
        except OSError as error:
            raise RobotError(f"the simulated controller on {self.host} does not answer ({error})") from error
        if not line:
            raise RobotError(f"the simulated controller on {self.host} has ended")
        answer: dict[str, Any] = json.loads(line)
        if not answer.pop("ok"):
            raise RobotError(f"the simulated controller refused {answer['error']}")
        return answer

    def close(self) -> None:
        self._lines.close()
        self._socket.close()

    def __enter__(self) -> AdminClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class SimulatedController:
    """A running child. It ends with `stop`, with the `with` block, and when this process dies."""

    def __init__(self, host: str, process: subprocess.Popen[bytes]) -> None:
        self.host = host
        self.process = process

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def admin(self) -> AdminClient:
        """A new connection to the admin port. Raises RobotError."""
        return AdminClient(self.host)

    def stop(self, timeout_s: float = STOP_TIMEOUT_S) -> None:
        """Ends the child, by force if it does not listen. Idempotent."""
        if self.running:
            self.process.terminate()
            try:
                self.process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            if pipe is not None:
                pipe.close()

    def __enter__(self) -> SimulatedController:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()


def start_controller(
    model: str = "UR10",
    *,
    host: str | None = None,
    truth: Path | None = None,
    time_scale: float = 1.0,
    timeout_s: float = 15.0,
    log: Path | None = None,
    options: tuple[str, ...] = (),
) -> SimulatedController:
    """Starts the child and waits until all its ports listen; blocking, call it outside an event loop.

    host None: a random free 127.x.y.z. log: where its standard error goes. options: further arguments of
    the command line. Raises RobotError with the child's last words.
    """
    command = [sys.executable, "-m", "station.simulation.controller", "--model", model, "--die-with-parent"]
    command += ["--time-scale", str(time_scale), *options]
    if truth is not None:
        command += ["--truth", str(truth)]
    attempts = 1 if host is not None else ATTEMPTS
    while True:
        attempts -= 1
        address = host or _random_loopback()
        child, problem = _start([*command, "--host", address], timeout_s, log)
        if not problem:
            return SimulatedController(address, child)
        if child.returncode != ADDRESS_TAKEN or attempts == 0:
            raise RobotError(f"the simulated {model} did not start: {problem}")


def _random_loopback() -> str:
    return f"127.{random.randint(1, 254)}.{random.randint(0, 255)}.{random.randint(1, 254)}"


def _start(command: list[str], timeout_s: float, log: Path | None) -> tuple[subprocess.Popen[bytes], str]:
    """The child, and why it is not ready and has been ended ("" = it is)."""
    with log.open("a+b") if log is not None else tempfile.TemporaryFile() as stderr:
        said_before = stderr.seek(0, os.SEEK_END)
        child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, start_new_session=True
        )
        if b'"ready": true' in _read_line(child, timeout_s):
            return child, ""
        _end(child)
        stderr.seek(said_before)
        words = stderr.read().decode(errors="replace").strip()
    return child, words or f"no ready line within {timeout_s:g} s"


def _end(child: subprocess.Popen[bytes]) -> None:
    """Waits for a child that is ending by itself, or kills it; closes its pipes."""
    try:
        child.wait(END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        child.kill()
    child.communicate()


def _read_line(child: subprocess.Popen[bytes], timeout_s: float) -> bytes:
    """The first line of its standard output, b"" when it ends or is too late."""
    assert child.stdout is not None
    deadline_s = time.monotonic() + timeout_s
    with selectors.DefaultSelector() as selector:
        selector.register(child.stdout, selectors.EVENT_READ)
        line = b""
        while not line.endswith(b"\n"):
            if not selector.select(max(0.0, deadline_s - time.monotonic())):
                return b""
            piece = child.stdout.read1(4096)  # type: ignore[attr-defined]
            if not piece:
                return b""
            line += piece
    return line


class SimulatedGige:
    """A running child; it ends with `stop`, with the `with` block, and when this process dies."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process

    def inject(self, fault: str, value: Any = None) -> None:
        """A fault of `camera_faults`, or `packet-loss` with a share of packets; then it is in force."""
        self._ask(fault, value)

    def sent(self) -> int:
        """Numbered pictures that went out so far, plus the number of the first."""
        return int(self._ask("sent")["number"])

    def _ask(self, name: str, value: Any = None) -> dict[str, Any]:
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps({"name": name, "value": value}) + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise CameraError(f"the GigE simulator ended on the fault '{name}'")
        return dict(json.loads(answer))

    def stop(self) -> None:
        """Idempotent."""
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self.process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> SimulatedGige:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def start_gige(
    controller_host: str = "",
    *,
    truth: Path | None = None,
    serial: str = "SIM00000",
    address: str = "127.0.0.1",
    numbered: bool = False,
) -> SimulatedGige:
    """Blocking until it listens; call it outside an event loop. CameraError with its last words.

    Refused where there is any network interface but `lo`: GigE discovery broadcasts on all of them.
    """
    if not is_isolated():
        raise CameraError(
            "the GigE simulator runs only in a network namespace with nothing but lo: "
            "start the program with `python -m station.simulation.netns` in `unshare --net`"
        )
    command = [sys.executable, "-m", "station.simulation.gige", "--address", address, "--serial", serial]
    command += ["--numbered"] if numbered else ["--controller-host", controller_host]
    command += [] if truth is None else ["--truth", str(truth)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    if not process.stdout.readline():
        process.wait()
        raise CameraError("the GigE simulator did not start; what it said is above")
    return SimulatedGige(process)
