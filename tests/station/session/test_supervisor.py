"""What the status tells a person that no event would: what waits, what holds the arm, what was solved."""

from __future__ import annotations

import asyncio
from unittest.mock import Mock

import msgspec
import pytest

from station.cell.status import StationState as S
from station.devices.news import Delay
from station.devices.rtde import RobotMode, SafetyMode
from station.protocol.verbs import Purpose
from station.session import supervisor
from tests.patience import until
from tests.station.session_rig import POSES, NewRig, Rig, sealed


async def test_a_wish_that_waits_for_the_pose_is_told_until_it_is_carried_out(rig: Rig) -> None:
    await rig.go_until_it_moves()
    assert rig.session.store.status.pending == ""
    rig.session.pause("anna")
    assert rig.session.store.status.pending == supervisor.PAUSES, "told before the answer"
    rig.arm.arrive.set()
    await rig.until(S.PAUSED)
    await until(lambda: rig.session.store.status.pending == "")
    assert rig.pose_states == ["done", *["planned"] * (POSES - 1)] and rig.cause == "paused"
    assert "anna" in rig.session.store.status.reason
    await asyncio.sleep(0.05)
    assert rig.arm.log.count("move") == 1, "going on needs a new go"
    await rig.go_until(S.MOVING, purpose=Purpose.RESUME)
    await rig.session.finish(1)
    assert rig.session.store.status.pending == supervisor.FINISHES
    rig.arm.arrive.set()
    await rig.until(S.IDLE)
    assert len(sealed(rig).views()) == 2


async def test_what_holds_an_arm_at_rest_is_told(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    def held() -> str:
        return rig.session.store.status.robot.condition.held

    good = rig.arm.state
    assert held() == ""
    stopped = msgspec.structs.replace(good(), safety_mode=SafetyMode.PROTECTIVE_STOP)
    monkeypatch.setattr(rig.arm, "state", lambda: stopped)
    await until(lambda: held().startswith("protective stop:"))
    assert "acknowledge" not in held()  # nothing is latched here
    off = msgspec.structs.replace(good(), robot_mode=RobotMode.POWER_OFF)
    monkeypatch.setattr(rig.arm, "state", lambda: off)
    await until(lambda: "has no power" in held())
    monkeypatch.setattr(rig.arm, "state", good)
    await until(lambda: held() == "")


async def test_the_question_says_that_a_playback_moves_nothing(new_rig: NewRig) -> None:
    rig = await new_rig(source="playback")
    summary = await rig.session.prepare(1, Purpose.RUN)
    assert summary.warnings == ("PLAYBACK of a recording: no arm moves",)
    assert rig.session.store.status.robot.condition.held == ""


@pytest.mark.parametrize("place", ["before_round", "after_round", "_watch_link"])
async def test_a_defect_in_the_heartbeats_loop_stops_the_arm_in_fault_and_the_loop_goes_on(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, place: str
) -> None:
    broken = Mock(side_effect=ZeroDivisionError)

    monkeypatch.setattr("station.session.session.BEGIN_AGAIN_S", 0.01)
    await rig.go_until_it_moves()
    with monkeypatch.context() as patch:
        patch.setattr(rig.session.supervisor, place, broken)
        await rig.until(S.FAULT)
        assert rig.cause == "internal" and rig.told("internal")
        await until(lambda: "stop" in rig.arm.log and broken.call_count > 5)
    assert sum(record.exc_info is not None for record in caplog.records) == 1, "one that stays fills no log"
    await rig.session.acknowledge("anna")
    rig.arm.beats, rig.arm.slow = 0, False
    await rig.go_until(S.IDLE, purpose=Purpose.RESUME)
    assert rig.arm.beats and len(sealed(rig).views()) == POSES


async def test_a_defect_in_the_stop_that_follows_a_defect_is_logged_too(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(rig.session.supervisor, "before_round", Mock(side_effect=ZeroDivisionError))
        patch.setattr(rig.arm, "stop", Mock(side_effect=IndexError))
        await rig.until(S.FAULT)
        await until(lambda: rig.session.supervisor.before_round.call_count > 1)
    logged = [record.exc_info[0] for record in caplog.records if record.exc_info]
    assert logged == [ZeroDivisionError, IndexError]


async def test_news_of_a_resting_arm_that_came_late_are_told_with_what_made_them_late(rig: Rig) -> None:
    rig.arm.late, rig.arm.gap_s = True, 0.8
    watch = rig.session.supervisor
    await until(lambda: watch._late_since_s)
    watch._late_since_s -= 0.5
    rig.arm.late = False
    await until(lambda: rig.told(Delay.CONTROLLER))
    assert rig.state is S.IDLE
