"""The process that drives the arm dies or freezes in mid-move: the arm stops, nothing of it stays behind."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.faults.conftest import MakeCell
from tests.patience import until

pytestmark = pytest.mark.process

DRIVER = """
import asyncio, sys
from pathlib import Path
from station.cell.config import RobotConfig
from station.cell.errors import RobotError
from station.devices.ur import UrRobot

async def main(host, folder, control):
    robot = UrRobot(RobotConfig(host=host, control=control), folder / "log")
    await robot.connect()
    async def heart():
        while True:
            robot.heartbeat()
            await asyncio.sleep(0.03)
    beating = asyncio.create_task(heart())
    await robot.start_control()
    goal = list(robot.newest().state.joints_rad)
    goal[0] += 1.5
    print(robot.control_pid, flush=True)
    try:
        await robot.move(goal, 0.5, 1.0)
    except RobotError as error:
        print(error.code, flush=True)

asyncio.run(main(sys.argv[1], Path(sys.argv[2]), sys.argv[3]))
"""


@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGSTOP], ids=["SIGKILL", "SIGSTOP"])
async def test_driving_process(cell: MakeCell, tmp_path: Path, kill: int) -> None:
    c = await cell(control=False)
    await c.robot.close()
    command = [sys.executable, "-c", DRIVER, c.controller.host, str(tmp_path), c.robot.control_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as driver:
        assert driver.stdout is not None
        child_pid = int(await asyncio.to_thread(driver.stdout.readline))
        await c.until(lambda state: max(map(abs, state["joint_speeds_rad_s"])) > 0.4)
        os.kill(driver.pid, kill)
        begun = time.monotonic()
        await c.stops()  # 1/5 s of silence, then the controller decelerates
        c.note_times(0.0, time.monotonic() - begun)
        await c.stays_at_rest()
        if kill == signal.SIGSTOP:
            driver.send_signal(signal.SIGCONT)
            assert (await asyncio.to_thread(driver.stdout.readline)).strip() == "computer-late"
        driver.kill()
    await until(lambda: not Path(f"/proc/{child_pid}").exists() or _is_zombie(child_pid))
    await c.until(lambda state: state["program"] is None)


def _is_zombie(pid: int) -> bool:
    try:
        return " Z " in Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return True
