"""Start of simulated devices as child processes: controller, on a free loopback address, and GigE camera."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, Self

from station.cell.child import ChildProcess, start_child
from station.cell.errors import CameraError, RobotError
from station.cell.process import give_own_priority
from station.simulation.netns import is_isolated

Json = dict[str, Any]
"""Message between parent and child: a JSON object in one line."""
ADMIN_PORT = 29990
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

    It gets a random 127.x.y.z. log: file for its standard error. options: further arguments of the
    command line. module: another program with the same command line. Raises StationError with the child's
    last output.
    """
    first, second, third = os.urandom(3)  # of 16 million addresses
    host = f"127.{first % 254 + 1}.{second}.{third % 254 + 1}"
    command = [sys.executable, "-m", module, "--model", model, "--host", host, "--die-with-parent"]
    command += ["--time-scale", str(time_scale), *options]
    if truth is not None:
        command += ["--truth", str(truth)]
    process = start_child(f"simulated {model}", command, CONTROLLER_TIMEOUT_S, log).process
    give_own_priority(process.pid)
    return SimulatedController(host, process)


def start_gige(controller_host: str, truth: Path, serial: str, log: Path | None = None) -> ChildProcess:
    """Start the camera on 127.0.0.1 and wait until it listens; blocking, so call it outside an event loop.

    log: where its standard error goes. Raises StationError with the child's last output.

    CameraError where there is any network interface but `lo`: GigE discovery broadcasts on all of them.
    """
    if not is_isolated():
        raise CameraError("not-isolated")
    command = [sys.executable, "-m", "station.simulation.gige", controller_host, str(truth), serial]
    return start_child("simulated GigE camera", command, GIGE_TIMEOUT_S, log)
