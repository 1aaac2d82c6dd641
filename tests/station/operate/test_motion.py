"""What a command without a screen waits for before it begins."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any, cast

import pytest

from station.cell.errors import RefusedError
from station.cell.status import CameraStatus, RobotStatus, StationState, StationStatus
from station.operate import motion
from station.protocol.client import Client

CAMERA = CameraStatus(connected=True)
STANDING = RobotStatus(connected=True, joints_rad=(0.0,) * 6)


class Telling:
    """A daemon's client as far as it is needed here."""

    def __init__(self, *told: StationStatus) -> None:
        self._told = told

    async def statuses(self) -> AsyncIterator[StationStatus]:
        for status in self._told:
            yield status
        await asyncio.Event().wait()


def waited(*told: StationStatus) -> StationStatus:
    return asyncio.run(motion.wait_until_idle(cast("Client", Telling(*told))))


def idle(**fields: Any) -> StationStatus:
    return StationStatus(state=StationState.IDLE, camera=CAMERA, **fields)


def test_a_cell_is_ready_when_its_devices_are_there_and_the_joints_are_known() -> None:
    ready = idle(robot=STANDING)
    assert waited(StationStatus(), idle(robot=RobotStatus(connected=True)), ready) is ready


def test_a_playback_needs_no_joints() -> None:
    ready = idle(playback=True)
    assert waited(StationStatus(), ready) is ready


@pytest.mark.parametrize(
    ("told", "missing"),
    [
        (StationStatus(), "no-robot"),
        (StationStatus(state=StationState.IDLE, robot=STANDING), "no-camera"),
        (idle(robot=RobotStatus(connected=True)), "no-robot"),
    ],
)
def test_what_does_not_come_is_named(
    told: StationStatus, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motion, "CONNECT_WAIT_S", 0.01)
    with pytest.raises(RefusedError) as refused:
        waited(told)
    assert refused.value.code == missing
