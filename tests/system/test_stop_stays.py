"""STOP of a real arm's cell against a service that goes on asking: real daemon, driver and controller.

The arm is simulated; the daemon applies the rules of a real one (`CELL_SOURCE=real`).
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from station.cell.child import ChildProcess, start_child
from station.cell.pose_plan import Plan
from station.cell.socket_folder import user_name
from station.cell.status import StationState as S
from station.protocol.stop_client import send_stop
from tests.conftest import asked
from tests.patience import PATIENCE_S, until
from tests.system.conftest import SystemRig, status_when

pytestmark = pytest.mark.process

GOES_ON_S = 0.3
"""For so long the service goes on to ask after the arm rests."""


def more_in_a_soak(usual: Iterable[int], others: Iterable[int]) -> list[Any]:
    return [*usual, *(pytest.param(other, marks=pytest.mark.soak) for other in others)]


@contextmanager
def service(socket: Path, plan: Path) -> Iterator[ChildProcess]:
    """`tests.system.service` at work, in a session of its own: no person stands behind it."""
    command = [sys.executable, "-m", "tests.system.service", str(socket), str(plan)]
    with start_child("service", command, PATIENCE_S, None) as working:
        yield working


def refused_of(working: ChildProcess) -> dict[str, int]:
    """End a service; return how often it was refused, by code."""
    told, _ = working.process.communicate(timeout=PATIENCE_S)
    refused: dict[str, int] = json.loads(told)
    return refused


IN_A_TERMINAL = "import os, pty, sys; sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))"


def in_a_terminal(*command: str) -> int:
    """Run a command as a person does, in the foreground of a terminal; return its exit code."""
    return without_a_terminal(sys.executable, "-c", IN_A_TERMINAL, *command)


def without_a_terminal(*command: str) -> int:
    """As `ssh HOST COMMAND` runs it."""
    done = subprocess.run(command, start_new_session=True, stdin=subprocess.DEVNULL, capture_output=True)
    return done.returncode


@pytest.mark.parametrize("seed", more_in_a_soak(range(2), range(2, 42)))
async def test_no_service_moves_an_arm_between_stop_and_a_persons_acknowledgement(
    rig: SystemRig, short_plan: Plan, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """STOP comes at a random moment, while a service prepares, approves, or drives."""
    monkeypatch.setenv("CELL_SOURCE", "real")
    monkeypatch.setenv("CELL_SERVICE", user_name(os.getuid()))
    daemon = await rig.daemon()
    acknowledge = (sys.executable, "-m", "station.cli", "acknowledge", "--socket", str(daemon.socket))
    plan = rig.folder / "plan.json"
    plan.write_bytes(msgspec.json.encode(short_plan))
    async with await daemon.client() as watcher:
        await status_when(watcher, lambda s: s.state is S.IDLE and s.camera.connected)
        with service(daemon.socket, plan) as working:
            await asyncio.sleep(random.Random(seed).uniform(0.0, 4.0))
            assert send_stop(daemon.socket) is None
            await status_when(watcher, lambda s: s.state is S.STOPPED)
            await rig.rests()
            moves = asked(rig.admin, "move")
            await rig.stays_at_rest(GOES_ON_S)
            assert await asyncio.to_thread(without_a_terminal, *acknowledge) == 1
            await rig.stays_at_rest(GOES_ON_S)
            assert asked(rig.admin, "move") == moves
            assert (await asyncio.to_thread(refused_of, working)).get("no-terminal", 0) > 3
        status = await status_when(watcher, lambda s: s.state is S.STOPPED)
        assert status.services_barred
        assert await asyncio.to_thread(in_a_terminal, *acknowledge) == 0
        status = await status_when(watcher, lambda s: s.state is not S.STOPPED)
        assert not status.services_barred


async def test_a_daemon_that_was_killed_while_stopped_starts_stopped(
    rig: SystemRig, short_plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CELL_SOURCE", "real")
    first = await rig.daemon()
    async with await first.client() as anna:
        await status_when(anna, lambda s: s.state is S.IDLE)
        await anna.request("stop")
        await until(lambda: list(rig.root.glob("latch-*.json")))
    first.process.kill()
    await asyncio.to_thread(first.process.wait, PATIENCE_S)
    second = await rig.daemon()
    async with await second.client() as anna:
        status = await status_when(anna, lambda s: s.robot.connected)
        assert (status.state, status.cause) == (S.STOPPED, "stop")
        assert "uid" in status.reason or user_name(os.getuid()) in status.reason
