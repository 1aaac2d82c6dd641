"""Sessions with devices in memory."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from recordings.errors import RecordingError
from recordings.schema.messages import Image
from station.cell.pose_plan import Plan
from station.cell.status import StationState
from station.session.recording import SessionRecording
from tests.station.quick_plan import quick_plan
from tests.station.session_rig import POSES, TRUTH, CameraInMemory, HeldDisk, NewRig, Rig, memory_config


@pytest.fixture(scope="session")
def small_plan() -> Plan:
    return quick_plan(memory_config(), TRUTH, seed=3, count=POSES)


@pytest.fixture
async def new_rig(tmp_path: Path, small_plan: Plan) -> AsyncIterator[NewRig]:
    rigs: list[Rig] = []

    async def make(*, with_plan: bool = True, source: Any = "simulated", guides: bool = False) -> Rig:
        rig = Rig(tmp_path / "root", source, guides=guides)
        rigs.append(rig)
        await rig.start()
        if with_plan:
            await rig.until(StationState.IDLE)
            rig.session.take_lease(1, "anna")
            rig.session.load_plan(1, small_plan)
        return rig

    yield make
    for rig in rigs:
        await rig.session.close()


@pytest.fixture
async def rig(new_rig: NewRig) -> Rig:
    return await new_rig()


@pytest.fixture
async def bare_rig(new_rig: NewRig) -> Rig:
    """Without a plan; the operator has control."""
    rig = await new_rig(with_plan=False)
    await rig.until(StationState.IDLE)
    rig.session.take_lease(1, "anna")
    return rig


@pytest.fixture
def held_camera(monkeypatch: pytest.MonkeyPatch) -> asyncio.Event:
    """A camera whose images come once the event is set."""
    given, capture = asyncio.Event(), CameraInMemory.capture

    async def held(camera: CameraInMemory, timeout_s: float = 5.0) -> Image:
        await given.wait()
        return await capture(camera, timeout_s)

    monkeypatch.setattr(CameraInMemory, "capture", held)
    return given


@pytest.fixture
def held_disk(monkeypatch: pytest.MonkeyPatch) -> HeldDisk:
    disk, sync = HeldDisk(), SessionRecording.sync

    async def held(recording: SessionRecording) -> None:
        disk.asked += 1
        await disk.wait()
        if disk.fails:
            raise RecordingError()
        await sync(recording)

    monkeypatch.setattr(SessionRecording, "sync", held)
    return disk
