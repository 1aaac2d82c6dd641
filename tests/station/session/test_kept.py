"""What a session keeps: what a restart finds again, what the recording tells, what a person was told."""

from __future__ import annotations

import errno
import os

import msgspec
import pytest

from recordings.errors import RecordingError
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose, Retake, Skip
from tests.codes import raises
from tests.durability import disk_order
from tests.patience import until
from tests.station.session_rig import POSES, NewRig, Rig, crash, sealed


def under_way(rig: Rig, moves: int) -> bool:
    return rig.arm.under_way and rig.arm.log.count("move") == moves


async def test_a_pose_that_failed_is_known_after_a_crash(new_rig: NewRig) -> None:
    first = await new_rig()
    first.camera.fail = ["frame lost"] * 3
    first.arm.slow = True
    await first.give_go()
    await until(lambda: under_way(first, 1))
    first.arm.arrive.set()
    await until(lambda: under_way(first, 2))
    crash(first)
    second = await new_rig(with_plan=False)
    assert second.pose_states == ["failed", "planned", "planned", "planned"]
    assert "frame lost" in second.session.store.status.session.poses[0].reason


async def test_a_plan_that_was_changed_in_a_pause_is_known_after_a_crash(new_rig: NewRig) -> None:
    first = await new_rig()
    await first.go_until_it_moves()
    await first.pause_after_this_pose("anna")
    await first.session.edit(1, Skip(2))
    crash(first)
    second = await new_rig(with_plan=False)
    assert second.pose_states == ["done", "planned", "skipped", "planned"]


async def test_a_change_that_the_disk_does_not_take_is_told_to_who_asked(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    await rig.go_until_it_moves()
    await rig.pause_after_this_pose("anna")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("station.session.recording.write_state", full)
    with raises("change-not-saved", RecordingError):
        await rig.session.edit(1, Skip(2))
    assert rig.pose_states == ["done", "planned", "skipped", "planned"]


async def test_a_drift_check_is_still_one_after_a_crash(new_rig: NewRig) -> None:
    first = await new_rig()
    first.arm.slow = True
    await first.give_go(Purpose.DRIFT_CHECK)
    await first.until(S.MOVING)
    await first.pause_after_this_pose("anna")
    crash(first)
    second = await new_rig(with_plan=False)
    assert second.session.store.status.session.check
    await second.session.acknowledge("anna")
    second.session.take_lease(1, "anna")
    await second.session.finish(1)
    await second.give_go()
    assert not second.session.store.status.session.check


async def test_a_picture_counts_until_its_pose_was_taken_again(rig: Rig) -> None:
    await rig.go_until_it_moves()
    await rig.pause_after_this_pose("anna")
    await rig.session.edit(1, Retake(0))
    assert rig.session.store.status.session.captured == 1
    await rig.session.finish(1)
    assert len(list(sealed(rig).views())) == rig.session.store.status.session.captured


async def test_an_arm_that_stands_at_its_pose_is_not_moved(rig: Rig) -> None:
    await rig.go_until_it_moves()
    await rig.pause_after_this_pose("anna")
    await rig.session.edit(1, Retake(0))
    rig.arm.slow = False
    await rig.give_go(Purpose.RESUME)
    await rig.until(S.IDLE)
    assert rig.arm.log.count("move") == POSES
    assert sealed(rig).views()[0].attempt == 2


@pytest.mark.parametrize("trouble", [(), ("frame lost",)])
async def test_what_people_were_told_is_in_the_recording(rig: Rig, trouble: tuple[str, ...]) -> None:
    rig.camera.fail = list(trouble)
    await rig.give_go()
    await rig.until(S.IDLE)
    recording = sealed(rig)
    assert "anna" in rig.told("approved")[0].text
    assert rig.told("finished")[0].values == {"captured": POSES, "poses": POSES, "path": str(recording.path)}
    written = [event.detail for event in recording.events()]
    assert rig.told("recording")[0].text in written
    assert sum("frame lost" in text for text in written) == len(trouble)


async def test_the_name_of_a_sessions_folder_is_on_the_disk_before_its_first_pose_counts(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Data that no name leads to after a power loss would be lost with it."""
    with disk_order(monkeypatch) as order:
        await rig.give_go()
        await until(lambda: rig.pose_states[0] == "done")
        until_then = list(order)
        await rig.until(S.IDLE)
    assert {"sync sessions", f"sync {rig.session.context.root.name}"} <= set(until_then)


@pytest.mark.parametrize(("name", "kept"), [("main", ""), ("overhead", "overhead")])
async def test_the_cameras_name_goes_with_its_recording(rig: Rig, name: str, kept: str) -> None:
    """Under it the calibration is installed; recordings of a cell with one camera stay as they were."""
    cell = rig.session.context.cell
    camera = msgspec.structs.replace(cell.config.camera, name=name)
    object.__setattr__(cell, "config", msgspec.structs.replace(cell.config, camera=camera))
    await rig.give_go()
    await rig.until(S.IDLE)
    assert sealed(rig).info.camera_identity.name == kept
