"""Start of simulated devices as child processes: controller, on a free loopback address, and GigE camera."""

from __future__ import annotations

import json
import os
import random
import socket
import subprocess
import sys
import tempfile
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from recordings.files import open_regular
from station.cell.errors import CameraError, RobotError
from station.cell.process import give_own_priority
from station.simulation.netns import is_isolated

Json = dict[str, Any]
"""Message between parent and child: a JSON object in one line."""
ADMIN_PORT = 29990
ATTEMPTS = 5
ADDRESS_TAKEN = 1
"""Exit code of a controller that cannot listen on its address."""
STOP_TIMEOUT_S = 3.0
END_TIMEOUT_S = 0.5
CONTROLLER_TIMEOUT_S, GIGE_TIMEOUT_S, ANSWER_S = 15.0, 30.0, 5.0


class AdminClient:
    """Connection to a simulated controller's admin port; blocking with time-outs, for one thread."""

    def __init__(self, host: str) -> None:
        """Raises RobotError when nothing listens there."""
        self.host = host
        try:
            self._socket = socket.create_connection((host, ADMIN_PORT), ANSWER_S)
        except OSError as error:
            raise self._gone(str(error)) from error
        self._lines = self._socket.makefile("rb")

    def ask(self, cmd: str, **arguments: object) -> Json:
        """Send a command; return the answer's fields. RobotError when refused, or the simulation is gone."""
        try:
            self._socket.sendall(json.dumps({"cmd": cmd, **arguments}).encode() + b"\n")
            line = self._lines.readline()
        except OSError as error:
            raise self._gone(str(error)) from error
        if not line:
            raise self._gone("it has ended")
        answer: Json = json.loads(line)
        if not answer.pop("ok"):
            raise RobotError("simulation-refused", reason=answer["error"])
        return answer

    def _gone(self, reason: str) -> RobotError:
        return RobotError("no-simulation", device=f"controller on {self.host}:{ADMIN_PORT}", reason=reason)

    def close(self) -> None:
        self._lines.close()
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ChildProcess:
    """Child process that ends by `stop`, at the end of its `with` block, or when this process dies."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def stop(self, timeout_s: float = STOP_TIMEOUT_S) -> None:
        """End the child, by force if it does not react. Idempotent."""
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()  # it ends with its input
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class SimulatedController(ChildProcess):
    def __init__(self, host: str, process: subprocess.Popen[bytes]) -> None:
        super().__init__(process)
        self.host = host

    def admin(self) -> AdminClient:
        """A new connection to the admin port. Raises RobotError."""
        return AdminClient(self.host)


def start_controller(
    model: str = "UR10",
    *,
    truth: Path | None = None,
    time_scale: float = 1.0,
    log: Path | None = None,
    options: tuple[str, ...] = (),
    module: str = "station.simulation.controller",
) -> SimulatedController:
    """Start a controller and wait until all its ports listen; blocking, so call it outside an event loop.

    It gets a random free 127.x.y.z. log: file for its standard error. options: further arguments of the
    command line. module: another program with the same command line. Raises RobotError with the child's last
    output.
    """
    command = [sys.executable, "-m", module, "--model", model, "--die-with-parent"]
    command += ["--time-scale", str(time_scale), *options]
    if truth is not None:
        command += ["--truth", str(truth)]
    for attempt in range(ATTEMPTS, 0, -1):
        host = f"127.{random.randint(1, 254)}.{random.randint(0, 255)}.{random.randint(1, 254)}"
        child, problem = _start([*command, "--host", host], CONTROLLER_TIMEOUT_S, log)
        if not problem:
            give_own_priority(child.pid)
            return SimulatedController(host, child)
        if child.returncode != ADDRESS_TAKEN or attempt == 1:
            break
    raise RobotError("simulation-not-started", device=model, reason=problem, exit_code=child.returncode)


def _start(command: list[str], timeout_s: float, log: Path | None) -> tuple[subprocess.Popen[bytes], str]:
    """Start a child; return it, and why it was not ready and was ended ("": it is ready)."""
    kept = None if log is None else open_regular(log, os.O_RDWR | os.O_APPEND | os.O_CREAT)
    with tempfile.TemporaryFile() if kept is None else os.fdopen(kept, "a+b") as stderr:
        said_before = stderr.seek(0, os.SEEK_END)
        child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, start_new_session=True
        )
        assert child.stdout is not None
        late = threading.Timer(timeout_s, child.kill)
        late.start()
        ready = b'"ready": true' in child.stdout.readline()
        late.cancel()
        if ready:
            return child, ""
        try:
            child.wait(END_TIMEOUT_S)  # it may be ending already
        except subprocess.TimeoutExpired:
            child.kill()
        child.communicate()
        stderr.seek(said_before)
        words = stderr.read().decode(errors="replace").strip()
    return child, words or f"no ready line within {timeout_s:g} s"


def start_gige(
    controller_host: str = "",
    *,
    truth: Path | None = None,
    serial: str = "SIM00000",
    log: Path | None = None,
) -> ChildProcess:
    """Start the camera on 127.0.0.1 and wait until it listens; blocking, so call it outside an event loop.

    log: where its standard error goes.

    CameraError where there is any network interface but `lo`: GigE discovery broadcasts on all of them.
    """
    if not is_isolated():
        raise CameraError("not-isolated")
    command = [sys.executable, "-m", "station.simulation.gige", "--serial", serial]
    command += ["--controller-host", controller_host, *([] if truth is None else ["--truth", str(truth)])]
    process, problem = _start(command, GIGE_TIMEOUT_S, log)
    if problem:
        raise CameraError("simulation-not-started", device="GigE camera", reason=problem)
    return ChildProcess(process)
