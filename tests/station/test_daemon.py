"""The daemon as a whole, with devices in memory."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from pathlib import Path

import pytest

from station.daemon import Daemon
from station.devices.cell import Cell
from tests.station.session_rig import ArmInMemory, CameraInMemory, WorkerInThisProcess, memory_config


@pytest.fixture
def thawed() -> Iterator[None]:
    yield
    gc.unfreeze()


async def test_what_was_loaded_is_not_searched_for_garbage_beside_a_moving_arm(
    thawed: None, tmp_path: Path
) -> None:
    """All modules of a daemon are some 90 000 objects: 0.05 to 0.1 s, as long as a heartbeat may be old."""
    daemon = Daemon(
        Cell(memory_config(), ArmInMemory(), CameraInMemory(), "simulated"), tmp_path / "root", tmp_path / "s"
    )
    daemon.session.context.workers = WorkerInThisProcess()  # type: ignore[assignment]
    left: list[int] = []

    def ready() -> None:
        left.append(len(gc.get_objects()))
        daemon.end()

    await daemon.run(ready)
    assert left[0] < 5000
