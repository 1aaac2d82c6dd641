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
import rtde_control, rtde_receive, rtde_io, dashboard_client
from station.simulation.launch import AdminClient
from tests.patience import wait_until as until
host = sys.argv[1]
admin = AdminClient(host)
result = {}
HOME = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
NEAR = [0.2, -1.5, 1.5, -1.5, -1.5, 0.1]
FAR = [1.2, -1.5, 1.5, -1.5, -1.5, 0.1]
def near(q, goal):
    return max(abs(a - b) for a, b in zip(q, goal)) < 1e-6
def fastest(speeds):
    return max(map(abs, speeds))
def finished(control):
    return control.getAsyncOperationProgress() < 0
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


@pytest.mark.parametrize(("model", "rate"), [("UR10", 125), ("UR10e", 500)])
def test_the_wheel_reads_moves_and_asks(controller: Start, model: str, rate: int) -> None:
    result = wheel(
        controller(model, time_scale=4),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        result["start"] = receive.getActualQ()
        until(lambda: receive.getRuntimeState() == 2)  # its script plays before the next state tells so
        result["modes"] = [receive.getRobotMode(), receive.getSafetyMode(), receive.getRuntimeState()]
        result["steady"] = control.isSteady()
        result["moveJ"] = control.moveJ(NEAR, 1.0, 2.0)
        until(lambda: near(receive.getActualQ(), NEAR))
        result["setTcp"] = control.setTcp([0, 0, 0.1, 0, 0, 0])
        result["offset"] = control.getTCPOffset()
        pose = receive.getActualTCPPose()
        result["ik"] = control.getInverseKinematics(pose)
        result["has"] = control.getInverseKinematicsHasSolution(pose)
        result["has not"] = control.getInverseKinematicsHasSolution([3, 0, 0, 0, 0, 0])
        result["fk"] = control.getForwardKinematics(NEAR, [0, 0, 0.1, 0, 0, 0])
        result["pose"] = pose
        goal = list(pose)
        goal[2] += 0.05
        result["moveL"] = control.moveL(goal, 0.1, 0.5)
        result["goal"] = goal
        until(lambda: fastest(receive.getActualQd()) < 1e-4)
        result["reached"] = receive.getActualTCPPose()
        result["within"] = [control.isPoseWithinSafetyLimits(goal), control.isJointsWithinSafetyLimits(HOME)]
        result["step"] = control.getStepTime()
        """,
    )
    home = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
    near = [0.2, -1.5, 1.5, -1.5, -1.5, 0.1]
    assert result["start"] == pytest.approx(home)
    assert result["modes"] == [7, 1, 2]
    assert result["steady"] and result["moveJ"] and result["setTcp"] and result["moveL"]
    assert result["offset"] == pytest.approx([0, 0, 0.1, 0, 0, 0])
    assert result["ik"] == pytest.approx(near, abs=1e-6)
    assert result["has"] is True and result["has not"] is False
    assert result["fk"] == pytest.approx(result["pose"], abs=1e-6)
    assert result["reached"] == pytest.approx(result["goal"], abs=1e-6)
    assert result["within"] == [True, True]


def test_asynchronous_moves_paths_and_stops(controller: Start) -> None:
    running = controller("UR10e")
    result = wheel(
        running,
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        result["accepted"] = control.moveJ(FAR, 1.0, 2.0, True)
        result["there"] = near(receive.getActualQ(), FAR)
        until(lambda: control.getAsyncOperationProgress() >= 0 and fastest(receive.getActualQd()) > 0.2)
        control.stopJ(5.0, False)
        until(lambda: fastest(receive.getActualQd()) < 1e-3)
        result["short"] = FAR[0] - receive.getActualQ()[0]
        result["finished"] = finished(control)
        path = [[*NEAR, 2.0, 4.0, 0.0], [*HOME, 2.0, 4.0, 0.0], [*NEAR, 2.0, 4.0, 0.0]]
        result["path"] = control.moveJ(path, True)
        seen = []
        until(lambda: seen.append(control.getAsyncOperationProgress()) or max(seen) >= 1)
        until(lambda: seen.append(control.getAsyncOperationProgress()) or seen[-1] < 0)
        result["progress"] = sorted(set(seen))
        until(lambda: near(receive.getActualQ(), NEAR))
        result["at"] = receive.getActualQ()
        control.moveJ(FAR, 1.0, 2.0, True)
        until(lambda: fastest(receive.getActualQd()) > 0.2)
        result["replaced"] = control.moveJ(NEAR, 2.0, 4.0, True)
        until(lambda: finished(control) and near(receive.getActualQ(), NEAR))
        control.stopScript()
        result["running"] = control.isProgramRunning()
        """,
    )
    assert result["accepted"] and not result["there"]
    assert result["short"] > 0.3
    assert result["finished"] and result["path"]
    assert {0, 1, 2} <= set(result["progress"])
    assert result["at"] == pytest.approx([0.2, -1.5, 1.5, -1.5, -1.5, 0.1], abs=1e-6)
    assert result["replaced"] and result["running"] is False


def test_speed_slider_by_the_wheel_and_on_the_pendant(controller: Start) -> None:
    result = wheel(
        controller("UR10"),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        io = rtde_io.RTDEIOInterface(host)
        io.setSpeedSlider(0.25)
        until(lambda: receive.getTargetSpeedFraction() < 0.26)
        result["fraction"] = receive.getTargetSpeedFraction()
        io.setStandardDigitalOut(3, True)
        io.setToolDigitalOut(1, True)
        until(lambda: receive.getActualDigitalOutputBits() >= 1 << 17)
        result["outputs"] = receive.getActualDigitalOutputBits()
        control.moveJ(FAR, 1.0, 10.0, True)
        until(lambda: fastest(receive.getTargetQd()) > 0.24)
        result["slow"] = fastest(receive.getTargetQd())
        admin.ask("slider", fraction=0.0)
        until(lambda: fastest(receive.getTargetQd()) < 1e-6)
        result["zero"] = [fastest(receive.getTargetQd()), control.getAsyncOperationProgress()]
        admin.ask("slider", fraction=1.0)
        until(lambda: near(receive.getActualQ(), FAR))
        """,
    )
    assert result["fraction"] == pytest.approx(0.25) and result["slow"] == pytest.approx(0.25, abs=0.01)
    assert result["outputs"] == 1 << 3 | 1 << 17
    assert result["zero"][0] < 1e-6 and result["zero"][1] == 0


def test_streams_modes_and_custom_scripts_do_what_they_say(controller: Start) -> None:
    result = wheel(
        controller("UR10e"),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        control.speedL([0, 0, -0.05, 0, 0, 0], 0.5)
        until(lambda: receive.getActualTCPSpeed()[2] < -0.0499)
        result["speed"] = receive.getActualTCPSpeed()
        control.speedStop()
        q = receive.getTargetQ()
        for i in range(200):
            start = control.initPeriod()
            q[5] += 0.001
            control.servoJ(q, 0, 0, 0.002, 0.1, 300)
            control.waitPeriod(start)
        control.servoStop()
        result["servo"] = q[5] - receive.getTargetQ()[5]
        result["custom"] = control.sendCustomScriptFunction("turn", "movej([0.1,-1.5,1.5,-1.5,-1.5,0])\\n")
        result["at"] = receive.getTargetQ()
        control.reuploadScript()
        until(control.isProgramRunning)
        control.stopScript()
        """,
    )
    assert result["speed"][:3] == pytest.approx([0, 0, -0.05], abs=2e-3)
    assert abs(result["servo"]) < 0.1, "it follows with its lookahead"
    assert result["custom"] and result["at"][0] == pytest.approx(0.1, abs=1e-3)
