"""What a session keeps: for a restart, in the recording, and on the screen until the next begins."""

from __future__ import annotations

import pytest

from recordings.errors import RecordingError
from station.cell.session_folder import STATE_FILE
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose, Retake, Skip
from tests.codes import raises
from tests.durability import full
from tests.patience import until
from tests.station.session_rig import POSES, NewRig, Rig, crash, sealed


def under_way(rig: Rig, moves: int) -> bool:
    return rig.arm.under_way and rig.arm.log.count("move") == moves


@pytest.mark.parametrize("written", ["skipped", "moving", "settling", "capturing", "writing"])
async def test_what_failed_and_what_was_changed_in_a_pause_is_known_after_a_crash(
    new_rig: NewRig, written: str
) -> None:
    """Also of a session of an earlier version, in which a pose was under way."""
    first = await new_rig()
    first.camera.fail = ["frame lost"] * 3
    first.arm.slow = True
    await first.give_go()
    await until(lambda: under_way(first, 1))
    first.arm.arrive.set()
    await until(lambda: under_way(first, 2))
    await first.pause_after_this_pose("anna")
    await first.session.edit(1, Skip(2))
    crash(first)
    (kept,) = first.session.context.root.rglob(STATE_FILE)
    kept.write_bytes(kept.read_bytes().replace(b'"skipped"', f'"{written}"'.encode()))
    second = await new_rig(with_plan=False)
    third = written if written == "skipped" else "planned"
    assert second.pose_states == ["failed", "done", third, "planned"]
    assert "frame lost" in second.session.store.status.session.poses[0].reason


async def test_a_change_that_the_disk_does_not_take_is_told_to_who_asked(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    await rig.go_until_it_moves()
    await rig.pause_after_this_pose("anna")

    monkeypatch.setattr("station.session.recording.write_state", full)
    with raises("change-not-saved", RecordingError):
        await rig.session.edit(1, Skip(2))
    assert rig.pose_states == ["done", "planned", "skipped", "planned"]


async def test_a_drift_check_is_still_one_after_a_crash(new_rig: NewRig) -> None:
    first = await new_rig()
    first.arm.slow = True
    await first.go_until(S.MOVING, purpose=Purpose.DRIFT_CHECK)
    await first.pause_after_this_pose("anna")
    crash(first)
    second = await new_rig(with_plan=False)
    assert second.session.store.status.session.check
    await second.session.acknowledge("anna")
    second.session.take_lease(1, "anna")
    await second.session.finish(1)
    status = second.session.store.status
    assert status.checked.captured == 1
    assert not status.session.check and not status.session.poses, "nobody knows what stood before it"


@pytest.mark.parametrize("again", [False, True])
async def test_a_picture_counts_until_its_pose_was_taken_again_by_an_arm_that_stands_there(
    rig: Rig, again: bool
) -> None:
    await rig.go_until_it_moves()
    await rig.pause_after_this_pose("anna")
    await rig.session.edit(1, Retake(0))
    assert rig.session.store.status.session.captured == 1
    rig.arm.slow = False
    await (rig.go_until(S.IDLE, purpose=Purpose.RESUME) if again else rig.session.finish(1))
    assert rig.arm.log.count("move") == (POSES if again else 1)
    assert [view.attempt for view in sealed(rig).views()] == ([2] + [1] * (POSES - 1) if again else [1])


async def test_the_sealed_session_stays_shown_until_the_go(rig: Rig) -> None:
    await rig.go_until(S.IDLE)
    before = rig.session.store.status.session
    summary = await rig.session.prepare(1, Purpose.RUN)
    assert summary.poses == POSES
    assert rig.session.store.status.session == before  # the answer may be no
    rig.arm.slow = True
    await rig.session.go(1, summary.token)
    begun = rig.session.store.status.session
    assert (begun.captured, begun.elapsed_s, begun.recording) == (0, 0.0, "")
    assert set(rig.pose_states) == {"planned"}


async def test_pictures_by_hand_after_a_sealed_session_are_a_session_of_their_own(rig: Rig) -> None:
    await rig.go_until(S.IDLE)
    for pictures in (1, 2):
        await rig.session.switch_free_drive(1, True)
        begun = rig.session.store.status.session
        assert (begun.captured, begun.elapsed_s, begun.recording) == (0, 0.0, "")
        assert set(rig.pose_states) == {"planned"} and len(rig.pose_states) == POSES
        for _ in range(pictures):
            await rig.session.record(1)
        assert rig.session.store.status.session.captured == pictures
        await rig.session.switch_free_drive(1, False)
        await rig.session.finish(1)
        assert len(list(sealed(rig).views())) == pictures
