"""A pose that does not come to rest is left for the end: offered to a person, or tried once more headless."""

from __future__ import annotations

from typing import Any

import pytest

from recordings.reader import open_recording
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose, Retake
from tests.patience import until
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


async def give_headless_go(rig: Rig) -> None:
    summary = await rig.session.prepare(1, Purpose.RUN)
    await rig.session.go(1, summary.token, again=True)


async def test_headless_it_is_tried_once_more_at_the_end_by_the_same_go(rig: Rig, shaken: list[int]) -> None:
    await give_headless_go(rig)
    await rig.until(S.IDLE)
    assert rig.pose_states == ["done"] * POSES
    views = open_recording(rig.session.store.status.session.recording).views()
    assert {v.index: v.attempt for v in views} == {0: 1, SHAKY: 2, 2: 1, 3: 1}
    assert rig.arm.log.count("start control") == 1
    assert rig.told("retrying")[0].values == {"poses": 1}


async def test_once_more_is_once(rig: Rig, shaken: list[int]) -> None:
    shaken[:] = [1] * 99
    await give_headless_go(rig)
    await rig.until(S.PAUSED)
    status = rig.session.store.status
    assert status.session.poses[SHAKY].attempt == 2
    assert status.cause == "unsettled" and status.session.poses[1].cause == "not-settled"


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


@pytest.mark.parametrize("end", ["pause", "stop", "finish"])
async def test_nothing_is_tried_again_once_the_go_is_over(rig: Rig, shaken: list[int], end: str) -> None:
    shaken[:] = [1] * 99
    await give_headless_go(rig)
    await until(lambda: rig.pose_states[SHAKY] == "failed")
    if end == "pause":
        rig.session.pause("bert")
    elif end == "stop":
        await rig.session.stop("bert")
    else:
        await rig.session.finish(1)
    await rig.until(S.PAUSED, S.STOPPED, S.IDLE)
    assert rig.session.store.status.session.poses[SHAKY].attempt == 1
