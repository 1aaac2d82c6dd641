"""Time from the daemon's call of STOP until its bytes are out, and until the arm begins to slow down.

A simulated UR10e (500 Hz) cruises at 0.5 rad/s, driven by ur_rtde and by the station's own script; STOP
comes at a random moment. Four ways: `stop()` as the daemon calls it (both paths at once), the control process
alone, the dashboard alone, and no heartbeat any more (from the last one on). The controller notes when a stop
reached it, on the same host clock. First deceleration: the first cycle whose commanded step is smaller than
the one before by more than 1 %, its time by the fitted clock; rest: the first cycle without a step. Runs with
the daemon's priority.
"""

from __future__ import annotations

import asyncio
import random
import tempfile
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import get_args

import numpy as np

from benchmarks.trials import table, trials
from recordings.schema.messages import RobotState
from station.cell.config import ControlPath, RobotConfig
from station.cell.errors import RobotError
from station.cell.process import DAEMON_NICENESS, go_before_others
from station.devices.base import fresh
from station.devices.ur import UrRobot
from station.devices.ur_dashboard import STOP
from station.simulation.launch import AdminClient, start_controller

TRIALS = 200
CRUISE_RAD_S = 0.5
Times = dict[str, list[float]]
"""Milliseconds since the call, by what happened."""


class LatencyRig:
    """One arm that swings its base joint to and fro."""

    def __init__(self, robot: UrRobot, admin: AdminClient) -> None:
        self.robot = robot
        self.admin = admin
        self.states: list[RobotState] = []
        self.beating = True
        self.beat_ns = 0
        self._forth = True
        robot.subscribe(self.states.append)

    async def cruise(self) -> asyncio.Task[None]:
        if not self.robot.control:
            await self.robot.start_control()
        goal = list((await fresh(self.robot)).joints_rad)
        goal[0] += 1.5 if self._forth else -1.5
        self._forth = not self._forth
        move = asyncio.create_task(self.robot.move(goal, CRUISE_RAD_S, 1.4))
        while abs(self.robot.newest().state.joint_speeds_rad_s[0]) < 0.99 * CRUISE_RAD_S:
            if move.done():
                await move  # why it ended
            await asyncio.sleep(0.005)
        await asyncio.sleep(random.uniform(0.02, 0.12))
        self.states.clear()
        return move

    async def heart(self) -> None:
        while True:
            if self.beating:
                self.beat_ns = time.monotonic_ns()
                self.robot.heartbeat()
            await asyncio.sleep(0.03)

    async def rest(self, move: asyncio.Task[None]) -> None:
        with suppress(RobotError):
            await move
        while abs(self.robot.newest().state.joint_speeds_rad_s[0]) > 1e-3:
            await asyncio.sleep(0.005)
        await self.robot.idle()

    def deceleration_ns(self) -> tuple[int, int]:
        """Host times of the first cycle with a shorter step, and of the first without any."""
        clock = self.robot.clock()
        assert clock is not None
        targets = np.array([s.target_joints_rad[0] for s in self.states])
        steps = np.abs(np.diff(targets))
        shorter = int(np.argmax(steps < 0.99 * steps[0]))
        still = shorter + int(np.argmax(steps[shorter:] < 1e-9))
        shorter_ns, still_ns = (
            clock.to_host_ns(self.states[i + 1].stamps.controller_s) for i in (shorter, still)
        )
        return shorter_ns, still_ns

    def received_ns(self, source: str, verb: str, since_ns: int) -> int | None:
        """When the controller noted it."""
        entries = self.admin.ask("log", since_monotonic_ns=since_ns)["entries"]
        return next((e["monotonic_ns"] for e in entries if (e["source"], e["verb"]) == (source, verb)), None)


async def trial(context: LatencyRig, way: str, times: Times) -> None:
    move = await context.cruise()
    robot = context.robot
    child, dashboard = robot._child, robot.dashboard
    if child is None or dashboard is None:
        await context.rest(move)
        raise RobotError()
    if way == "no heartbeat":
        context.beating = False
        begun_ns = context.beat_ns
        await context.rest(move)
        context.beating = True
        note(context, begun_ns, times)
        return
    ways: dict[str, Callable[[], Awaitable[object] | None]] = {
        "both": lambda: robot.stop("benchmark"),
        "control process": child.stop,
        "dashboard": lambda: dashboard.send(STOP),
    }
    begun_ns = time.monotonic_ns()
    going = ways[way]()
    if way == "both":
        assert going is not None
        task = asyncio.ensure_future(going)
        await asyncio.sleep(0)  # stop() writes to both paths before it first waits
        handed_ns = time.monotonic_ns()
        await task
        times["stop() returned"].append((time.monotonic_ns() - begun_ns) / 1e6)
    else:
        handed_ns = time.monotonic_ns()
    times["bytes handed to the kernel"].append((handed_ns - begun_ns) / 1e6)
    await context.rest(move)
    stop = "stopj" if robot.control_path == "script" else "stopJ"
    source, verb = ("script", stop) if way == "control process" else ("dashboard", "stop")
    received_ns = context.received_ns(source, verb, begun_ns)
    if received_ns is not None:
        times[f"{source} {verb} reached the controller"].append((received_ns - begun_ns) / 1e6)
    note(context, begun_ns, times)


def note(context: LatencyRig, begun_ns: int, times: Times) -> None:
    shorter_ns, still_ns = context.deceleration_ns()
    times["first deceleration"].append((shorter_ns - begun_ns) / 1e6)
    times["rest"].append((still_ns - begun_ns) / 1e6)


async def measure(
    host: str, admin: AdminClient, folder: Path, count: int, control: ControlPath
) -> list[tuple[str, ...]]:
    robot = UrRobot(RobotConfig(model="UR10e", host=host, control=control), folder / "log")
    await robot.connect()
    context = LatencyRig(robot, admin)
    beating = asyncio.create_task(context.heart())
    rows, disturbed = [], 0
    for way in ("both", "control process", "dashboard", "no heartbeat"):
        times: Times = defaultdict(list)
        while len(times["first deceleration"]) < count:
            try:
                await trial(context, way, times)
            except RobotError:  # this machine was too busy for the watchdog, before the STOP
                disturbed += 1
                await robot.stop("disturbed")
                await robot.idle()
        rows += [(control, way, event, str(len(ms)), *_spread(ms)) for event, ms in times.items()]
    beating.cancel()
    await robot.close()
    repeated = "trials repeated: the machine held up the session before the STOP"
    rows.append((control, "–", repeated, str(disturbed), *"––––"))
    return rows


def _spread(milliseconds: list[float]) -> tuple[str, ...]:
    return tuple(f"{v:.2f}" for v in np.percentile(milliseconds, [50, 90, 99, 100]))


def run() -> str:
    """A markdown table."""
    go_before_others(DAEMON_NICENESS)
    with (
        tempfile.TemporaryDirectory() as folder,
        start_controller("UR10e") as controller,
        controller.admin() as admin,
    ):
        rows = []
        for control in get_args(ControlPath):
            rows += asyncio.run(measure(controller.host, admin, Path(folder), trials(TRIALS), control))
    return table(("control", "path", "from the call until", "n", "p50 ms", "p90", "p99", "max"), rows)
