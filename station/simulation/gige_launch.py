"""Starts the simulated GigE camera as a child process and passes faults to it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from station.cell.errors import CameraError
from station.simulation.netns import is_isolated

_STOP_TIMEOUT_S = 3.0


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
