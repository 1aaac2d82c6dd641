"""The daemon as a whole, with devices in memory."""

from __future__ import annotations

import asyncio
import gc
import os
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest

from station.cell.pose_plan import Plan
from station.cell.status import StationState
from station.daemon import Daemon
from station.devices.cell import Cell
from station.protocol.client import Client
from tests.patience import until
from tests.station.session_rig import ArmInMemory, CameraInMemory, WorkerInThisProcess, memory_config


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    """Not yet running; it serves on the socket `s`."""
    arm = ArmInMemory()
    cell = Cell(memory_config(), arm, CameraInMemory(), "simulated", arm)
    made = Daemon(cell, tmp_path / "root", tmp_path / "s")
    made.session.context.workers = WorkerInThisProcess()
    yield made
    gc.unfreeze()


async def test_what_was_loaded_is_not_searched_for_garbage_beside_a_moving_arm(daemon: Daemon) -> None:
    """All modules of a daemon are some 90 000 objects: 0.05 to 0.1 s, as long as a heartbeat may be old."""
    left: list[int] = []

    def ready() -> None:
        left.append(len(gc.get_objects()))
        daemon.end()

    await daemon.run(ready)
    assert left[0] < 5000


async def test_a_defect_in_what_tells_the_screens_is_a_fault_and_they_are_told(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("station.session.session.BEGIN_AGAIN_S", 0.01)
    publish = Mock(side_effect=ZeroDivisionError("a defect"))
    monkeypatch.setattr(daemon._client_server, "publish", publish)
    served_s = daemon._served_s
    running = asyncio.create_task(daemon.run())
    await until(lambda: publish.call_count > 3)
    assert daemon._served_s == served_s, "systemd ends a daemon in which the defect stays"
    publish.side_effect = None
    await until(lambda: daemon._served_s > served_s)
    assert daemon.session.store.state is StationState.FAULT
    daemon.end()
    await running


_TOUCHED: list[str] = []
_LOOPS: set[int] = set()
"""Threads whose files are watched."""


def _watch_files(event: str, arguments: tuple[object, ...]) -> None:
    if threading.get_ident() not in _LOOPS or "'/proc/" in str(arguments[:1]):
        return
    if event == "open" or event.startswith(("os.", "shutil.", "glob.")):
        frame: FrameType | None = sys._getframe()
        while frame is not None and "/station/" not in frame.f_code.co_filename.replace(__file__, ""):
            frame = frame.f_back
        where = f"{frame.f_code.co_filename}:{frame.f_lineno}" if frame is not None else ""
        _TOUCHED.append(f"{event} {arguments[:1]} {where}")


async def test_the_loop_of_the_heartbeat_touches_no_file(
    daemon: Daemon, tmp_path: Path, small_plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk or a file server may answer late or never: everything else goes on."""
    sys.addaudithook(_watch_files)  # for ever, but it looks at watched threads only
    for name in ("stat", "statvfs", "fsync", "fdatasync"):  # these are not told to hooks
        real = getattr(os, name)

        def told(*args: Any, name: str = name, real: Callable[..., Any] = real, **named: Any) -> Any:
            _watch_files(f"os.{name}", args)
            return real(*args, **named)

        monkeypatch.setattr(os, name, told)
    ready = asyncio.Event()
    running = asyncio.create_task(daemon.run(ready.set))
    await ready.wait()
    _LOOPS.add(threading.get_ident())
    try:
        async with Client(tmp_path / "s") as anna:
            await anna.request("load_plan", plan=msgspec.to_builtins(small_plan))
            await anna.request("doctor")
            summary = await anna.request("prepare", purpose="run")
            await anna.request("go", token=summary["token"])
            async with asyncio.timeout(60):
                async for status in anna.statuses():
                    if status.session.recording:
                        break
    finally:
        _LOOPS.clear()
    daemon.end()
    await running
    assert _TOUCHED == []
