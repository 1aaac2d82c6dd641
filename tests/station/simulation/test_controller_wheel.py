"""The unmodified ur_rtde wheel against the simulated controller. Faults: tests/faults."""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap
from collections.abc import Callable
from typing import Any

import pytest

from station.devices.ur import library_installed
from station.simulation.launch import SimulatedController
from tests.patience import PATIENCE_S

pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(not library_installed(), reason="ur_rtde is not installed"),
]
Start = Callable[..., SimulatedController]

_BEFORE = """
import json, os, sys
import rtde_control, rtde_receive
from station.simulation.launch import AdminClient
from tests.patience import wait_until as until
host = sys.argv[1]
admin = AdminClient(host)
result = {}
NEAR = [0.2, -1.5, 1.5, -1.5, -1.5, 0.1]
FAR = [1.2, -1.5, 1.5, -1.5, -1.5, 0.1]
def near(q, goal):
    return max(abs(a - b) for a, b in zip(q, goal)) < 1e-6
def fastest(speeds):
    return max(map(abs, speeds))
"""
_AFTER = """
print("RESULT", json.dumps(result), flush=True)
os._exit(0)  # never the wheel's destructors
"""


def wheel(running: SimulatedController, code: str) -> dict[str, Any]:
    """Run code against the unmodified wheel in a process of its own; return its `result`."""
    source = _BEFORE + textwrap.dedent(code) + _AFTER
    child = subprocess.run(
        [sys.executable, "-c", source, running.host], capture_output=True, text=True, timeout=PATIENCE_S
    )
    (line,) = [line for line in child.stdout.splitlines() if line.startswith("RESULT ")] or [child.stderr]
    result: dict[str, Any] = json.loads(line.removeprefix("RESULT "))
    return result


@pytest.mark.parametrize("model", ["UR10", "UR10e"])
def test_the_wheel_moves_stops_and_ends(controller: Start, model: str) -> None:
    """By the calls that the station makes, and by reading beside them."""
    running = controller(model, time_scale=4)
    with running.admin() as admin:
        admin.ask("tcp", pose=[0, 0, 0.1, 0, 0, 0])
    result = wheel(
        running,
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        result["start"] = receive.getActualQ()
        until(lambda: receive.getRuntimeState() == 2)  # its script plays before the next state tells so
        result["modes"] = [receive.getRobotMode(), receive.getSafetyMode(), receive.getRuntimeState()]
        result["offset"] = control.getTCPOffset()
        result["moveJ"] = control.moveJ(NEAR, 1.0, 2.0)
        until(lambda: near(receive.getActualQ(), NEAR))
        result["accepted"] = control.moveJ(FAR, 1.0, 2.0, True)
        result["there"] = near(receive.getActualQ(), FAR)
        until(lambda: control.getAsyncOperationProgress() >= 0 and fastest(receive.getTargetQd()) > 0.2)
        admin.ask("slider", fraction=0.0)
        until(lambda: fastest(receive.getTargetQd()) < 1e-6)
        result["waits"] = control.getAsyncOperationProgress()
        admin.ask("slider", fraction=1.0)
        until(lambda: fastest(receive.getTargetQd()) > 0.2)
        control.stopJ(5.0, False)
        until(lambda: fastest(receive.getActualQd()) < 1e-3)
        result["short"] = FAR[0] - receive.getActualQ()[0]
        result["finished"] = control.getAsyncOperationProgress() < 0
        result["replaced"] = [control.moveJ(FAR, 1.0, 2.0, True), control.moveJ(NEAR, 2.0, 4.0, True)]
        until(lambda: near(receive.getActualQ(), NEAR))
        control.stopScript()
        result["running"] = control.isProgramRunning()
        """,
    )
    assert result["start"] == pytest.approx([0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0])
    assert result["modes"] == [7, 1, 2]
    assert result["offset"] == pytest.approx([0, 0, 0.1, 0, 0, 0])
    assert result["moveJ"] and result["accepted"] and not result["there"]
    assert result["waits"] == 0 and result["short"] > 0.1 and result["finished"]
    assert result["replaced"] == [True, True] and result["running"] is False
