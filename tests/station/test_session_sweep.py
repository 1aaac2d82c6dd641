"""A sweep obeys every rule of a session, and its pictures are on the disk."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from recordings.reader import Recording
from station.analysis import Sighting
from station.errors import RefusedError
from station.plan.sweep import SWINGS, sweep_plan
from station.status import DetectionStatus
from station.status import StationState as S
from tests.station.session_rig import TRUTH, Rig, sealed


@pytest.fixture
async def sweeping(rig: Rig) -> Rig:
    rig.session.load_plan(1, sweep_plan("UR10", "eye-in-hand", TRUTH.start_joints_rad))
    return rig


async def test_it_swings_takes_pictures_and_comes_back(sweeping: Rig) -> None:
    sweeping.arm.slow = True
    summary = await sweeping.session.prepare(1, "run")
    assert "sweep: 8 slow swings" in summary.purpose and sweeping.arm.log == []
    sweeping.session.go(1, summary.token)
    for number in range(SWINGS):
        await sweeping.until_true(lambda n=number: sweeping.arm.log.count("move") == n + 1)
        before = sweeping.camera.taken
        await sweeping.until_true(lambda before=before: sweeping.camera.taken > before + 2)
        sweeping.arm.arrive.set()
    await sweeping.until(S.IDLE)
    assert sweeping.arm.joints == pytest.approx(TRUTH.start_joints_rad)
    assert sweeping.pose_states == ["done"] * SWINGS
    recording: Recording = sealed(sweeping)
    assert len(recording.parts[0].picture_sequences()) > 2 * SWINGS
    assert list(recording.views()) == []


async def test_stop_ends_swing_and_pictures(sweeping: Rig) -> None:
    sweeping.arm.slow = True
    await sweeping.give_go()
    await sweeping.until_true(lambda: sweeping.camera.taken > 3)
    await sweeping.session.stop("anna")
    taken = sweeping.camera.taken
    assert sweeping.session.store.state is S.STOPPED and "stop" in sweeping.arm.log
    await asyncio.sleep(0.1)
    assert sweeping.camera.taken == taken and sweeping.arm.log.count("move") == 1
    sweeping.session.acknowledge("anna")
    assert sweeping.session.store.state is S.PAUSED
    with pytest.raises(RefusedError, match="not valid"):
        sweeping.session.go(1, "the old one")


async def test_without_the_board_in_view_nothing_moves(sweeping: Rig) -> None:
    sweeping.worker.sees = Sighting(DetectionStatus(reason="too dark"), np.arange(0), np.zeros((0, 2)))
    await sweeping.give_go()
    await sweeping.until(S.IDLE)
    assert "board in view: too dark" in sweeping.session.store.status.reason
    assert "move" not in sweeping.arm.log and sweeping.session.bench.recording is None


async def test_a_camera_that_fails_again_and_again_ends_it_after_the_swing(sweeping: Rig) -> None:
    sweeping.arm.slow = True
    await sweeping.give_go()
    await sweeping.until_true(lambda: sweeping.camera.taken > 3)
    sweeping.camera.fail = ["no picture"] * 5
    await sweeping.until_true(lambda: len(sweeping.camera.fail) == 2)
    sweeping.arm.arrive.set()
    await sweeping.until(S.PAUSED)
    assert sweeping.arm.log.count("move") == 1


async def test_a_full_disk_stops_the_arm_at_once(sweeping: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    sweeping.arm.slow = True
    await sweeping.give_go()
    await sweeping.until_true(lambda: sweeping.camera.taken > 3)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("recordings.mcap_file.os.writev", full)
    await sweeping.until(S.FAULT)
    assert "No space left" in sweeping.session.store.status.reason
    await sweeping.until_true(lambda: "stop" in sweeping.arm.log)
