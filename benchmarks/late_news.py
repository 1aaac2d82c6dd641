"""News from a simulated robot, late by 120, 300 and 800 ms: does a resting arm wait, does a moving one stop?

Who is late is made so: the controller is halted (SIGSTOP), its link carries nothing (the simulated cable is
pulled), this computer does not read (its event loop is held), or the control process is halted.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import signal
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.trials import trials
from station.cell.config import RobotConfig
from station.cell.errors import RobotError
from station.devices.base import wait_for_state
from station.devices.news import Delay
from station.devices.ur import UrRobot
from station.simulation.launch import AdminClient, SimulatedController, start_controller

TRIALS = 20
LATE_S = (0.12, 0.3, 0.8)
BEAT_S = 0.02
FAR_RAD = 1.5


@dataclass
class Rig:
    controller: SimulatedController
    admin: AdminClient
    cable: AdminClient
    robot: UrRobot
    hold_s: float = 0.0
    """The event loop sleeps for so long at the next state."""
    lag_s: float = 0.0
    """Longest delay of a heartbeat since a trial began."""

    def on_state(self, _: object) -> None:
        held, self.hold_s = self.hold_s, 0.0
        if held:
            time.sleep(held)

    async def beat(self) -> None:
        while True:
            self.robot.heartbeat()
            due_s = time.monotonic() + BEAT_S
            await asyncio.sleep(BEAT_S)
            self.lag_s = max(self.lag_s, time.monotonic() - due_s)

    async def start(self) -> None:
        """Start control where it has ended, once what ended it is over."""
        while not self.robot.control:
            with contextlib.suppress(RobotError):
                await self.robot.start_control()
            await asyncio.sleep(BEAT_S)

    async def halt(self, pid: int | None, late_s: float) -> None:
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        try:
            await asyncio.sleep(late_s)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    async def controller_late(self, late_s: float) -> None:
        await self.halt(self.controller.process.pid, late_s)

    async def reader_late(self, late_s: float) -> None:
        self.hold_s = late_s
        await asyncio.sleep(late_s)

    async def link_late(self, late_s: float) -> None:
        await asyncio.to_thread(self.cable.ask, "black_hole")
        try:
            await asyncio.sleep(late_s)
        finally:
            await asyncio.to_thread(self.cable.ask, "black_hole", on=False)

    async def control_late(self, late_s: float) -> None:
        assert self.robot._child is not None
        await self.halt(self.robot._child.pid, late_s)

    def speed_rad_s(self) -> float:
        return float(max(map(abs, self.admin.ask("state")["joint_speeds_rad_s"])))


Fault = Callable[[Rig, float], Coroutine[object, object, None]]
FAULTS: dict[str, tuple[Fault, Delay]] = {
    "controller halted": (Rig.controller_late, Delay.CONTROLLER),
    "cable pulled": (Rig.link_late, Delay.CONTROLLER),  # on loopback there is no network to blame
    "this computer does not read": (Rig.reader_late, Delay.COMPUTER),
}
CONTROL_FAULTS = {**FAULTS, "control halted": (Rig.control_late, Delay.COMPUTER)}
TOLD_S = 0.25
"""Delays of the trials that are longer than this have a cause to be named."""


@contextlib.asynccontextmanager
async def rig(folder: Path) -> AsyncIterator[Rig]:
    controller = await asyncio.to_thread(start_controller, "UR10e")
    robot = UrRobot(RobotConfig(model="UR10e", host=controller.host), folder)
    made = Rig(controller, controller.admin(), controller.admin(), robot)
    robot.link.subscribe(made.on_state)
    await robot.link.connect()
    beating = asyncio.create_task(made.beat())
    try:
        yield made
    finally:
        await robot.link.close()
        beating.cancel()
        made.admin.close()
        made.cable.close()
        controller.stop()


async def at_rest(made: Rig, fault: Fault, late_s: float) -> tuple[str, str]:
    """What became of a decision in the middle of it, and what was named."""
    began_s, made.lag_s = time.monotonic(), 0.0
    faulty = asyncio.create_task(fault(made, late_s))
    await asyncio.sleep(min(0.11, late_s / 2))
    said = "waited"
    try:
        await wait_for_state(made.robot.link, checked=True)
    except RobotError as error:
        said = f"fault: {error.code}"
    await faulty
    await asyncio.sleep(0.15)
    cause = made.robot.link.delay(made.lag_s, began_s - 0.05)
    await asyncio.sleep(0.1)
    return said, cause.code if cause else "–"


async def moving(made: Rig, fault: Fault, late_s: float) -> tuple[str, float]:
    """What ended the move, '' for nothing, and when the arm rested after its news ended, seconds."""
    await made.start()
    joints = list(made.robot.link.states.sample(math.inf, connected=False).state.joints_rad)
    joints[0] += FAR_RAD if joints[0] < 0 else -FAR_RAD
    move = asyncio.create_task(made.robot.move(joints, 0.5, 1.0))
    while not move.done() and await asyncio.to_thread(made.speed_rad_s) < 0.4:
        await asyncio.sleep(0.01)
    began_s, rested_s = time.monotonic(), 0.0
    faulty = asyncio.create_task(fault(made, late_s))
    await asyncio.sleep(late_s + 0.05 if fault is Rig.controller_late else 0.0)  # it cannot be asked before
    while time.monotonic() < began_s + 2.0:
        if not rested_s and await asyncio.to_thread(made.speed_rad_s) < 1e-3:
            rested_s = time.monotonic() - began_s
        await asyncio.sleep(0.01)
        if rested_s and move.done():
            break
    await faulty
    try:
        await move
    except RobotError as error:
        return error.code, rested_s
    return "", 0.0


def run() -> str:
    return asyncio.run(_run())


async def _run() -> str:
    count = trials(TRIALS)
    rows = [f"{count} trials a row, UR10e simulated on loopback, heartbeat every {1000 * BEAT_S:.0f} ms.", ""]
    with tempfile.TemporaryDirectory() as folder:
        for table in (_at_rest, _in_motion):
            rows += [*await table(Path(folder), count), ""]
    return "\n".join(rows[:-1])


async def _at_rest(folder: Path, count: int) -> list[str]:
    rows = ["| at rest, late by | who | decided | named |", "|-|-|-|-|"]
    faults = right = told = 0
    async with rig(folder) as made:
        for late_s, who, fault, cause in _trials(FAULTS):
            ends = [await at_rest(made, fault, late_s) for _ in range(count)]
            said, named = (Counter(column) for column in zip(*ends, strict=True))
            faults += count - said["waited"]
            right += named[cause] if late_s > TOLD_S else 0
            told += count if late_s > TOLD_S else 0
            rows.append(f"| {1000 * late_s:.0f} ms | {who} | {_told(said)} | {_told(named)} |")
    return [*rows, f"| all | | {faults} faults | {right} of {told} right above 120 ms |"]


async def _in_motion(folder: Path, count: int) -> list[str]:
    rows = ["| in motion, late by | who | ended by | rests after, median, worst (s) |", "|-|-|-|-|"]
    needless = right = told = 0
    for late_s, who, fault, cause in _trials(CONTROL_FAULTS):
        async with rig(folder) as made:
            stops = [await moving(made, fault, late_s) for _ in range(count)]
        named, times = Counter(code for code, _ in stops), [seconds for code, seconds in stops if code]
        if late_s > TOLD_S:
            right, told = right + named[cause], told + count
        else:
            needless += len(times)
        worst = f"{statistics.median(times):.2f}, {max(times):.2f}" if times else "–"
        rows.append(f"| {1000 * late_s:.0f} ms | {who} | {_told(named)} | {worst} |")
    return [*rows, f"| all | | {needless} stopped at 120 ms; {right} of {told} causes right above | |"]


def _trials(faults: dict[str, tuple[Fault, Delay]]) -> Iterator[tuple[float, str, Fault, Delay]]:
    return ((late_s, who, *how) for late_s in LATE_S for who, how in faults.items())


def _told(counts: Counter[str]) -> str:
    return ", ".join(f"{count} {what or 'nothing'}" for what, count in counts.most_common())
