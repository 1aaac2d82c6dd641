"""A pose that does not come to rest is left for the end: offered to a person."""

from __future__ import annotations

from typing import Any

import pytest

from station.cell.status import StationState as S
from station.protocol.verbs import Purpose, Retake
from tests.station.session_rig import POSES, Rig

SHAKY = 1


async def test_a_person_is_asked(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pose 2 rings at its first attempt."""
    glimpse = rig.camera.glimpse

    async def ringing() -> Any:
        session = rig.session.store.status.session
        rig.camera.jumps = 3 if session.current == SHAKY and session.poses[SHAKY].attempt == 1 else 0
        return await glimpse()

    monkeypatch.setattr(rig.camera, "glimpse", ringing)
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
