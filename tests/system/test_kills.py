"""Random kills and freezes of the processes of a session: the arm rests, nothing acknowledged is lost."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from recordings.reader import open_recording
from recordings.recover import recover_recording
from station.cell.pose_plan import Plan
from station.cell.status import StationState as S
from tests.patience import PATIENCE_S, until
from tests.system.conftest import DaemonProcess, SystemRig, go, status_when
from tests.system.test_daemon import children_of

pytestmark = pytest.mark.process

VICTIMS = ("daemon", "control", "worker", "operator")
LATEST_S = 5.0
"""The strike comes at a random moment of the session's first seconds."""


def more_in_a_soak(usual: Iterable[int], others: Iterable[int]) -> list[Any]:
    return [*usual, *(pytest.param(other, marks=pytest.mark.soak) for other in others)]


def process_of(daemon: DaemonProcess, victim: str) -> int | None:
    """Number of the daemon's process, or of its child; None: it has none now."""
    if victim == "daemon":
        return daemon.process.pid
    for child in children_of(daemon.process.pid):
        with contextlib.suppress(OSError):
            controls = b"ur.control" in (child / "cmdline").read_bytes()
            if controls == (victim == "control"):
                return int(child.name)
    return None


@pytest.mark.parametrize("seed", more_in_a_soak(range(2), range(2, 42)))
async def test_whatever_is_struck_the_arm_rests_and_no_acknowledged_pose_is_lost(
    rig: SystemRig, short_plan: Plan, seed: int
) -> None:
    chance = random.Random(seed)
    victim = chance.choice(VICTIMS)
    blow = chance.choice((signal.SIGKILL, signal.SIGSTOP))
    daemon = await rig.daemon()
    watcher = await daemon.client()
    anna = await daemon.client()
    await go(anna, short_plan)
    folder = Path((await status_when(watcher, lambda s: bool(s.session.folder))).session.folder)
    await asyncio.sleep(chance.uniform(0.0, LATEST_S))
    status = await status_when(watcher, lambda s: True)
    acknowledged = status.session.captured
    if victim == "operator":
        await anna.close()  # as the kernel does it for a killed screen
    elif (pid := process_of(daemon, victim)) is not None:
        os.kill(pid, blow)
    if victim == "worker":  # another takes its place, and the session goes on
        await status_when(watcher, lambda s: s.state in (S.IDLE, S.PAUSED, S.FAULT))
    await rig.rests()
    await rig.stays_at_rest()
    for client in (anna, watcher):
        await client.close()
    daemon.process.send_signal(signal.SIGCONT)
    daemon.process.kill()
    await asyncio.to_thread(daemon.process.wait, PATIENCE_S)
    await until(lambda: not any(child.is_dir() for child in _children(daemon)))
    if list(folder.glob("*.part")):
        await asyncio.to_thread(recover_recording, folder)
    recorded = open_recording(folder).views() if list(folder.glob("*.mcap")) else []
    assert len(recorded) >= acknowledged, (victim, blow)


def _children(daemon: DaemonProcess) -> list[Path]:
    try:
        return children_of(daemon.process.pid)
    except OSError:
        return []
