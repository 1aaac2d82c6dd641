"""Time from the byte of F12 in a terminal until STOP is at the controller, and until the arm rests.

A simulated cell captures; the real screen shows it in a terminal of its own. F12 comes at a random moment of
a move, while busy programs compete for the processor, each in a session of its own. The controller notes when
a stop reached it, on the same host clock.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.trials import table, trials
from station.cell.errors import StationError
from station.cell.status import StationState
from station.cli.daemon import own_daemon
from station.cli.session import Attended, attended
from station.protocol.verbs import Acknowledge, MakePlan, Purpose
from station.simulation.launch import AdminClient
from tests.tui.terminal import ScreenProcess

TRIALS, LOADS = 150, (0, 8)
"""Presses at each load, and numbers of busy programs."""
LOOP = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"
Times = tuple[float, float]
"""Milliseconds from the byte until the controller had STOP, and until the arm rested."""


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    loops = [subprocess.Popen([sys.executable, "-c", LOOP], start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


async def press(shell: Attended, screen: ScreenProcess, admin: AdminClient) -> Times | None:
    """Press F12 in a move; None when the session ended before, or the arm was stopped by another way."""
    paused = (await shell.status()).state is StationState.PAUSED
    going = asyncio.create_task(shell.carry_out(Purpose.RESUME if paused else Purpose.RUN))
    while not going.done():
        await asyncio.sleep(random.uniform(0.02, 0.2))
        if admin.ask("state")["moving"]:
            break
    else:
        await going  # why it ended
        return None
    begun_ns = time.monotonic_ns()
    screen.press_now("f12")
    while admin.ask("state")["moving"]:
        await asyncio.sleep(0.001)
    rested_ms = (time.monotonic_ns() - begun_ns) / 1e6
    await going
    entries = admin.ask("log", since_monotonic_ns=begun_ns)["entries"]
    at_ns = [e["monotonic_ns"] for e in entries if (e["source"], e["verb"]) == ("dashboard", "stop")]
    return ((at_ns[0] - begun_ns) / 1e6, rested_ms) if at_ns else None


async def measure(socket: Path, screen: ScreenProcess, count: int) -> list[Times]:
    times = list[Times]()
    async with attended(socket, headless=True, quiet=True) as shell:
        assert shell.client.config is not None
        await shell.client.call(MakePlan(25, 0), timeout_s=200.0)
        with contextlib.closing(AdminClient(shell.client.config.robot.host)) as admin:
            while len(times) < count:
                with contextlib.suppress(StationError):  # nothing latched, or the computer was too busy
                    if pressed := await press(shell, screen, admin):
                        times.append(pressed)
                with contextlib.suppress(StationError):
                    await shell.client.call(Acknowledge())
    return times


def run() -> str:
    """A markdown table."""
    rows = []
    for load in LOADS:
        with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as ends:
            what = ["--simulate", "--root", folder]
            socket = ends.enter_context(own_daemon(what, Path(folder) / "daemon.log"))
            screen = ScreenProcess(socket)
            ends.callback(screen.end)
            screen.wait_for("IDLE")
            ends.enter_context(busy(load))
            times = asyncio.run(measure(socket, screen, trials(TRIALS)))
            for until, ms in zip(
                ("STOP at the controller", "the arm rests"), zip(*times, strict=True), strict=True
            ):
                spread = [f"{v:.1f}" for v in np.percentile(ms, [50, 90, 99, 100])]
                rows.append((str(load), until, str(len(ms)), *spread))
    return table(("busy programs", "from the byte until", "n", "p50 ms", "p90", "p99", "max"), rows)
