"""Starts a simulated controller as a child process on a free loopback address."""

from __future__ import annotations

import os
import random
import selectors
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType

from station.cell.errors import RobotError
from station.simulation.admin import AdminClient

ATTEMPTS = 5
ADDRESS_TAKEN = 1
"""Exit code of a controller that cannot listen on its address."""
STOP_TIMEOUT_S = 3.0
END_TIMEOUT_S = 0.5


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
