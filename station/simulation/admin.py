"""Client of a simulated controller's admin port."""

from __future__ import annotations

import json
import socket
from typing import Any

from station.cell.errors import RobotError

PORT = 29990


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
