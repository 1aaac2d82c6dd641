"""The unmodified ur_rtde wheel against the simulated controller, as users' own clients call it. What the
station calls of it: tests/faults."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import pytest

from station.simulation.launch import SimulatedController
from tests.conftest import no_library
from tests.patience import PATIENCE_S

PROGRAM = """
import os, sys
import rtde_control, rtde_receive
from station.simulation.launch import AdminClient
from tests.patience import wait_until as until

host = sys.argv[1]
admin = AdminClient(host)
admin.ask("tcp", pose=[0, 0, 0.1, 0, 0, 0])
START = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
NEAR, FAR = [0.2, -1.5, 1.5, -1.5, -1.5, 0.1], [1.2, -1.5, 1.5, -1.5, -1.5, 0.1]
def near(a, b): return max(abs(x - y) for x, y in zip(a, b)) < 1e-6

receive = rtde_receive.RTDEReceiveInterface(host)
control = rtde_control.RTDEControlInterface(host)
assert near(receive.getActualQ(), START)
until(lambda: receive.getRuntimeState() == 2)  # its script plays before the next state tells so
assert [receive.getRobotMode(), receive.getSafetyMode()] == [7, 1]
assert near(control.getTCPOffset(), [0, 0, 0.1, 0, 0, 0])
assert control.moveJ(NEAR, 1.0, 2.0)
until(lambda: near(receive.getActualQ(), NEAR))
assert control.moveJ(FAR, 1.0, 2.0, True) and control.moveJ(START, 2.0, 4.0, True)  # in its place
until(lambda: near(receive.getActualQ(), START) and control.getAsyncOperationProgress() < 0)
control.stopScript()
assert not control.isProgramRunning()
print("well", flush=True)
os._exit(0)  # never the wheel's destructors
"""


@no_library
@pytest.mark.process
def test_the_wheel_moves_and_ends(controller: Callable[..., SimulatedController]) -> None:
    running = controller(time_scale=4)
    command = [sys.executable, "-c", PROGRAM, running.host]
    child = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert child.stdout.splitlines()[-1:] == ["well"], child.stderr
