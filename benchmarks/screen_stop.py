"""Time from the STOP key to the daemon's stop call, and the screen's cost while it watches.

A real screen in a terminal of 160×48, attached to a daemon with a simulated cell whose previews it shows:
once in half blocks, once on a terminal that says it draws sixels (letters of 8×17 pixels).
The key is written to the terminal; the call is the moment in which `Session.stop` is entered. A press enters
it twice, by the screen's datagram and by its connection: the first stops the arm, and the next press waits
until the second has come too.
"""

from __future__ import annotations

import asyncio
import os
import random
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np

from benchmarks.trials import table, trials
from station.cell.status import StationState, StationStatus
from station.daemon import Daemon
from station.protocol.client import Client
from station.protocol.verbs import Go, Prepare
from station.simulation.launch_cell import SimulationOptions, simulated_cell
from tests.tui.terminal import ScreenProcess

PRESSES = 200
CAPTURE_POSES = 12
STOP_GOAL_MS, CPU_GOAL = 40.0, 0.10
WAYS = ("datagram", "connection")
"""Each of which brings a press to the daemon."""
RUNNING = (StationState.MOVING, StationState.SETTLING, StationState.CAPTURING, StationState.WRITING)


def run() -> str:
    rows = [*_rows("half blocks", sixels=False), *_rows("sixels", sixels=True)]
    first = os.sched_getscheduler(0) in (os.SCHED_RR, os.SCHED_FIFO)
    load = f"Load average at the end: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    load += ", this before all other work (`chrt -r 5`)." if first else "."
    return table(("what", "n", "p50", "p90", "p99", "max", "goal"), rows) + "\n\n" + load


def _rows(how: str, sixels: bool) -> list[tuple[object, ...]]:
    stop_ms, share, watched_s, pictures = asyncio.run(_measure(sixels))
    p50, p90, p99 = (f"{value:.1f}" for value in np.percentile(stop_ms, [50, 90, 99]))
    goals = f"p99 ≤ {STOP_GOAL_MS:.0f} ms", f"≤ {100 * CPU_GOAL:.0f} %"
    key = f"{how}: F12 written to the terminal → daemon's stop call (ms)"
    drawn = f", {pictures} pictures" if sixels else ""
    cost = f"{how}: screen's share of a core during a capture of {watched_s:.0f} s{drawn} (%)"
    return [
        (key, len(stop_ms), p50, p90, p99, f"{max(stop_ms):.1f}", goals[0]),
        (cost, 1, f"{100 * share:.1f}", "", "", "", goals[1]),
    ]


@asynccontextmanager
async def _daemon(folder: Path) -> AsyncIterator[tuple[Daemon, Path]]:
    socket = folder / "control.sock"
    cell = await asyncio.to_thread(simulated_cell, SimulationOptions(), folder / "cell")
    daemon = Daemon(cell, folder / "root", socket)
    ready = asyncio.Event()
    serving = asyncio.create_task(daemon.run(ready.set))
    try:
        await ready.wait()
        yield daemon, socket
    finally:
        daemon.end()
        await serving
        cell.ended()


async def _measure(sixels: bool) -> tuple[list[float], float, float, int]:
    with tempfile.TemporaryDirectory() as name:
        async with _daemon(Path(name)) as (daemon, socket), await Client.connect(socket) as operator:
            await _until(operator, lambda s: s.state is StationState.IDLE and s.camera.connected)
            await operator.request("lease", action="take")
            await operator.request("make_plan", poses=CAPTURE_POSES, seed=1, timeout_s=120.0)
            screen = await asyncio.to_thread(ScreenProcess, socket, 160, 48, sixels)
            try:
                await asyncio.to_thread(screen.wait_for, "● IDLE +SIMULATED")
                await asyncio.sleep(3.0)
                screen.press("3")
                await asyncio.to_thread(screen.wait_for, "Devices")
                before = screen.pictures
                share, watched_s = await _cpu_share(operator, screen)
                pictures = screen.pictures - before
                return await _presses(daemon, operator, screen), share, watched_s, pictures
            finally:
                await asyncio.to_thread(screen.end)


async def _cpu_share(operator: Client, screen: ScreenProcess) -> tuple[float, float]:
    """Measure the share of one core, by the screen's process, from the first move to the last picture."""
    summary = await operator.call(Prepare())
    await operator.call(Go(summary.token))
    await _until(operator, lambda s: s.state in RUNNING)
    begun_s, used_s = time.monotonic(), _cpu_s(screen.process.pid)
    await _until(operator, lambda s: s.state not in RUNNING)
    took_s = time.monotonic() - begun_s
    return (_cpu_s(screen.process.pid) - used_s) / took_s, took_s


def _cpu_s(pid: int) -> float:
    """User and system time of a process so far (fields 14 and 15 of proc(5))."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def _presses(daemon: Daemon, operator: Client, screen: ScreenProcess) -> list[float]:
    called: asyncio.Queue[float] = asyncio.Queue()
    stop = daemon.session.stop

    async def timed(who: str) -> None:
        called.put_nowait(time.perf_counter())
        await stop(who)

    daemon.session.stop = timed  # type: ignore[method-assign]
    times_ms = []
    for _ in range(trials(PRESSES)):
        assert called.empty(), "STOP without a press"
        begun_s = time.perf_counter()
        screen.press_now("f12")
        first_s, _ = [await asyncio.wait_for(called.get(), 10.0) for _ in WAYS]
        times_ms.append(1000 * (first_s - begun_s))
        await _until(operator, lambda s: s.state is StationState.STOPPED)
        await operator.request("acknowledge")
        await asyncio.sleep(random.uniform(0.1, 0.35))
    return times_ms


async def _until(client: Client, condition: Callable[[StationStatus], bool]) -> StationStatus:
    async for status in client.statuses():
        if condition(status):
            return status
    raise RuntimeError("the daemon ended")


if __name__ == "__main__":
    print(run())
