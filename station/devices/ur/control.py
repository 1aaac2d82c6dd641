"""Control process of the arm, by ur_rtde or by the station's own script: `python -m …ur.control`.

ur_rtde may hang, crash or abort, so it runs in this process, which can be killed. It is started by
`child`, answers requests on one inherited socket (one JSON object per message) and dies with its parent.
It never reconnects, never uploads its script twice and never moves without a request.

Requests: {"do": "beat", "ns": N}   N: host monotonic time of the session loop; resets the watchdog if fresh
          {"do": "move", "joints": [6], "speed": rad/s, "acceleration": rad/s²}
          {"do": "stop", "deceleration": …}
          {"do": "end"}
Answers:  {"ready": true, "tcp": [6] | null} · {"refused": an `ErrorData`}
          {"beat": N, "ns": N, "kicked": bool, "lost": bool}   kicked: the beat was fresh and the script took
                                                               it, at `ns`; lost: the script is gone
          {"moved": why not, empty: it was taken, "late_ms": age of a heartbeat that is too old, else 0}
          {"stopped": true}
"""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import sys
import time
from dataclasses import asdict
from typing import Any, NoReturn

from station.cell.errors import RobotError
from station.cell.process import (
    DAEMON_NICENESS,
    control_in_real_time,
    die_with_parent,
    go_before_others,
)

BEAT_FRESH_NS = 100_000_000
WATCHDOG_HZ = 5.0
"""Frequency of the controller's watchdog: it stops the script after 1/5 s without a reset."""
MESSAGE_LIMIT = 4096
LIBRARY_WORDS = {
    "in use": "registers-in-use",
    "remote control": "local-control",
    "start control script": "script-not-started",
}
"""Parts of ur_rtde's messages (it has no error codes), in lower case → code."""


class MotionServer:
    def __init__(self, control: Any, channel: socket.socket) -> None:
        self._control = control
        self._channel = channel
        self._beat_ns = 0
        self._armed = False
        self._script_lost = False
        self._stopped = False

    def serve(self) -> None:
        """Answer requests until the parent sends `end` or closes the socket."""
        while message := self._channel.recv(MESSAGE_LIMIT):
            request = json.loads(message)
            verb = request["do"]
            if verb == "beat":
                self._beat(int(request["ns"]))
            elif verb == "move":
                self.answer({"late_ms": self._late_ms, "moved": self._move(request)})
            elif verb == "stop":
                self._stopped = True
                # Synchronously, because ur_rtde 1.6.5 carries out an asynchronous stopJ as a stopl of the
                # tool. The stop is sent at once; the call returns when the joints rest.
                self._control.stopJ(float(request["deceleration"]), False)
                self.answer({"stopped": True})
            elif verb == "end":
                self._control.stopScript()
                return

    def answer(self, reply: dict[str, object]) -> None:
        self._channel.send(json.dumps(reply).encode())

    @property
    def _late_ms(self) -> float:
        """Age of the session's heartbeat where that alone refuses a move; 0: it does not."""
        return 0.0 if self._stopped or self._fresh() else (time.monotonic_ns() - self._beat_ns) / 1e6

    def _fresh(self) -> bool:
        return time.monotonic_ns() - self._beat_ns <= BEAT_FRESH_NS

    def _beat(self, beat_ns: int) -> None:
        """Reset the watchdog for a fresh heartbeat; never again once the script did not take one."""
        self._beat_ns, kicked = beat_ns, False
        if self._fresh() and not self._script_lost:
            armed = self._armed or self._arm()
            kicked = bool(armed and self._control.kickWatchdog())
            self._script_lost = not kicked
        now_ns, lost = time.monotonic_ns(), self._script_lost
        self.answer({"beat": beat_ns, "ns": now_ns, "kicked": kicked, "lost": lost})

    def _arm(self) -> bool:
        """Arm the watchdog: from now on the script ends without regular resets."""
        self._armed = bool(self._control.setWatchdog(WATCHDOG_HZ))
        return self._armed

    def _move(self, request: dict[str, Any]) -> str:
        joints = [float(q) for q in request["joints"]]
        if len(joints) != 6 or not all(map(math.isfinite, joints)):
            return f"six finite joint angles are needed, not {joints}"
        if self._stopped:
            return "a stop was asked for"
        if not self._fresh():
            return "the session's heartbeat is missing"
        # Before every move: after an unnoticed reconnection the script runs anew, without its watchdog.
        if self._script_lost or not self._arm():
            return "the control program is not running or its watchdog could not be armed"
        try:
            ok = self._control.moveJ(joints, float(request["speed"]), float(request["acceleration"]), True)
        except (ValueError, RuntimeError) as error:
            return str(error)
        return "" if ok else "the controller did not take the move"


def open_control(path: str, host: str) -> Any:
    """Connect by ur_rtde or `ScriptControl`, which has the same calls. Raises RobotError, OSError."""
    if path == "script":
        from station.devices.ur.script import ScriptControl

        return ScriptControl(host)
    try:
        from rtde_control import RTDEControlInterface
    except ImportError as error:
        raise RobotError("ur-rtde-missing", reason=str(error)) from None
    try:
        return RTDEControlInterface(host)
    except RuntimeError as error:
        words = str(error).lower()
        code = next((code for said, code in LIBRARY_WORDS.items() if said in words), "control")
        raise RobotError(code, reason=str(error)) from None


def main(path: str, host: str, descriptor: int, parent_pid: int) -> NoReturn:
    """Serve the inherited socket `descriptor`. Ends by os._exit: ur_rtde's destructors can hang or abort."""
    die_with_parent(parent_pid)
    go_before_others(DAEMON_NICENESS)
    control_in_real_time()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = socket.socket(fileno=descriptor)
    try:
        control = open_control(path, host)
    except (RobotError, OSError) as error:
        if not isinstance(error, RobotError):
            error = RobotError("control", reason=str(error))
        channel.send(json.dumps({"refused": asdict(error.data)}).encode())
        os._exit(1)
    server = MotionServer(control, channel)
    try:
        tcp: list[float] | None = control.getTCPOffset()
    except RuntimeError:
        tcp = None
    try:
        server.answer({"ready": True, "tcp": tcp})
        server.serve()
    except OSError as error:
        print(f"the parent is gone: {error}", file=sys.stderr, flush=True)
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
