"""A pose that does not come to rest is left for the end: offered to a person."""

from __future__ import annotations

from typing import Any

import pytest

from station.cell.status import StationState as S
from station.protocol.verbs import Purpose, Retake
from tests.station.session_rig import POSES, Rig

SHAKY = 1


@pytest.fixture
def shaken(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Pose 2 rings, as often as there are entries in here."""
    times = [1]
    glimpse = rig.camera.glimpse

    async def ringing() -> Any:
        current = rig.session.store.status.session.current
        rig.camera.jumps = 3 if current == SHAKY and times else 0
        return await glimpse()

    def calm() -> None:
        statuses = rig.session.store.status.session.poses
        if times and statuses and statuses[SHAKY].state == "failed":
            times.pop()

    monkeypatch.setattr(rig.camera, "glimpse", ringing)
    rig.session.store.watch(calm)
    return times


async def test_a_person_is_asked(rig: Rig, shaken: list[int]) -> None:
    await rig.give_go()
    await rig.until(S.PAUSED)
    assert rig.pose_states == ["done", "failed", "done", "done"]
    assert rig.cause == "unsettled"
    moves = rig.arm.log.count("move")
    await rig.session.edit(1, Retake(SHAKY))
    assert rig.arm.log.count("move") == moves
    await rig.give_go(Purpose.RESUME)
    await rig.until(S.IDLE)
    assert rig.pose_states == ["done"] * POSES
