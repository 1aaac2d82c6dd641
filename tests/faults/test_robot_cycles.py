"""Links that drop and come back, again and again: nothing hangs, nothing leaks."""

from __future__ import annotations

import asyncio
import gc
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from recordings.schema.messages import RobotState
from station.cell.errors import RobotError
from station.simulation.launch import SimulatedController
from tests.faults.conftest import Cell, MakeCell
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.process

WARM_UP = 6


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208  # Path.iterdir would hold one itself


def children() -> set[str]:
    own = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    return set(own)


def memory_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


async def drop(c: Cell, how: str) -> None:
    """Asks again when the drop came before the controller had accepted the link that just came back."""
    reader, begun_s, asked_s = c.robot.link.states.reader, time.monotonic(), 0.0
    while reader is not None and c.robot.link.states.reader is reader and reader.ended is None:
        assert time.monotonic() - begun_s < PATIENCE_S, "the robot's loss was not noticed"
        if time.monotonic() - asked_s > 1.0:
            asked_s = time.monotonic()
            await c.ask("drop", how=how)
        await asyncio.sleep(0.01)


async def cycle(c: Cell, number: int) -> None:
    """One drop and recovery; every fifth with control alive, every tenth with the arm in motion."""
    move = None
    if number % 5 == 0:
        await c.begin()
        if number % 10 == 0:
            move = c.far_move() if (await c.joints_rad())[0] < 2.0 else None
    await drop(c, "rst" if number % 2 else "fin")
    if move is not None:
        with pytest.raises(RobotError):
            await asyncio.wait_for(move, PATIENCE_S)
    await until(lambda: c.robot.link.states.connected and not c.robot.control)
    await asyncio.wait_for(c.robot.stops.idle(), PATIENCE_S)


async def run_cycles(c: Cell, count: int) -> None:
    before: dict[str, Any] = {}
    for number in range(count):
        await cycle(c, number)
        if number == min(WARM_UP, count // 2):
            gc.collect()
            before = {"fds": descriptors(), "children": children(), "threads": threading.active_count()}
            before["memory"] = memory_mb()
    gc.collect()
    await asyncio.sleep(0.5)
    assert children() == before["children"]
    assert abs(descriptors() - before["fds"]) <= 3  # a supervisor may be in the middle of a question
    assert abs(threading.active_count() - before["threads"]) <= 1
    growth_mb = memory_mb() - before["memory"]
    assert growth_mb < 5 + 0.01 * count, f"grew by {growth_mb:.1f} MB in {count} cycles"


async def test_twelve_cycles(cell: MakeCell) -> None:
    await run_cycles(await cell(control=False), 12)


@pytest.mark.soak
@pytest.mark.timeout(3600)
async def test_a_thousand_cycles(cell: MakeCell) -> None:
    await run_cycles(await cell(control=False), 1000)


@pytest.mark.soak
@pytest.mark.timeout(900)
async def test_ten_minutes_at_full_rate_without_a_lost_sample(
    controller: Callable[..., SimulatedController],
) -> None:
    from station.devices.ur.stream import StateReader

    seconds: float = 600
    count, skipped, before_s = 0, 0, 0.0

    def take(state: RobotState) -> None:
        nonlocal count, skipped, before_s
        skipped += bool(count and state.stamps.controller_s - before_s > 1.5 / 500)
        count, before_s = count + 1, state.stamps.controller_s

    reader = StateReader(controller("UR10e").host, take, lambda _: None)
    await reader.open()
    cpu_s = time.process_time()
    await asyncio.sleep(seconds)
    cpu_s = time.process_time() - cpu_s
    reader.close()
    assert not skipped
    assert count > 0.99 * seconds * 500
    assert cpu_s / seconds < 0.10
