"""What fails in a session: pictures, poses, arm, disk, the daemon itself."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from calibrate.views.corners import NO_CORNERS
from recordings.errors import MissingSegmentError, RecordingError
from recordings.reader import open_recording
from recordings.recorder import Recorder
from recordings.schema.messages import Image
from station.analysis.worker import Sighting
from station.cell.errors import CameraError, RobotError, SafetyStopError, TriggerError
from station.cell.status import StationState as S
from station.protocol.messages import news_line
from station.protocol.verbs import Purpose, Retake
from station.session.recording import SessionRecording
from tests.codes import raises
from tests.patience import until
from tests.station.session_rig import POSES, NewRig, Rig, crash, sealed


async def test_a_bad_picture_is_taken_again_and_then_the_pose_fails_alone(rig: Rig) -> None:
    rig.camera.fail = ["frame lost", "frame lost"]
    await rig.go_until(S.IDLE)
    assert rig.pose_states == ["done"] * POSES
    rig.camera.fail = ["gone"] * 3
    await rig.go_until(S.PAUSED)
    assert rig.pose_states == ["failed", "done", "done", "done"]
    assert rig.cause == "poses-failed"
    recording = rig.session.context.require_recording()
    shown_s = recording.elapsed_s
    assert shown_s == recording.elapsed_s, "no time is counted at rest"
    await rig.session.finish(1)
    assert [view.index for view in sealed(rig).views()] == [1, 2, 3]


async def test_a_picture_without_the_board_does_not_count(rig: Rig) -> None:
    shown = rig.worker.sees.detection
    hidden = replace(shown, cause="not-found", reason="board half hidden", corners=NO_CORNERS)
    rig.worker.sees = Sighting(hidden)
    await rig.go_until(S.PAUSED)
    status = rig.session.store.status
    assert rig.pose_states == ["failed"] * 3 + ["planned"]
    assert status.session.poses[0].reason == "board half hidden"
    assert status.cause == "failures"
    assert status.session.captured == 0


@pytest.mark.parametrize(
    "odd",
    ["\ud800 half a pair", "x" * 1_000_000, np.float64(1.5), math.nan, np.array([1.0, 2.0]), {1, 2}],
    ids=["surrogate", "long", "numpy", "nan", "array", "set"],
)
async def test_whatever_an_event_holds_the_recording_goes_on_and_screens_get_it_whole(
    rig: Rig, odd: Any
) -> None:
    """Half a surrogate pair, as of a file's name, ended the recording: "Free space or mend the disk"."""
    await rig.go_until_it_moves()
    store = rig.session.store
    store.event("odd", f"seen: {odd}", "warning", figure=odd, names=[odd])
    store.problem(RobotError("odd", figure=odd), said="because of {}")
    line, left_out = news_line(msgspec.structs.asdict(store.status), True)
    assert not left_out and len(line) < 100_000
    rig.arm.slow = False
    rig.arm.arrive.set()
    await rig.until(S.IDLE)
    assert rig.pose_states == ["done"] * POSES and sealed(rig)


async def test_a_protective_stop_stops_and_sends_nothing(rig: Rig) -> None:
    await rig.go_until_it_moves()
    rig.arm.trouble = SafetyStopError()
    rig.arm.arrive.set()
    await rig.until(S.STOPPED)
    assert rig.cause == "safety-stop"
    await until(lambda: not rig.arm.control)
    assert set(rig.arm.log) <= {"start control", "move", "end control"}
    await rig.session.acknowledge("anna")
    with pytest.raises(SafetyStopError):
        await rig.session.prepare(1, Purpose.RESUME)


@pytest.mark.parametrize(
    ("method", "error", "cause"),
    [
        ("sync", RecordingError(), "recording"),
        ("require_space", RecordingError(), "recording"),
        ("require_space", ZeroDivisionError("a defect"), "internal"),
    ],
)
async def test_a_disk_that_fails_is_a_fault_and_never_a_pose_and_so_is_a_defect(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, method: str, error: Exception, cause: str
) -> None:
    def fails(self: SessionRecording) -> None:
        raise error

    monkeypatch.setattr(SessionRecording, method, fails)
    await rig.go_until(S.FAULT)
    assert rig.cause == cause and str(error) in rig.session.store.status.reason
    await until(lambda: rig.arm.log[-1:] == ["end control"])
    assert "stop" in rig.arm.log and "done" not in rig.pose_states
    assert ("move" in rig.arm.log) == (method == "sync")


async def test_a_disk_that_takes_no_file_or_is_full_is_told_before_anybody_is_asked(rig: Rig) -> None:
    (probe := rig.session.context.root / ".write-test").mkdir()
    with raises("disk-full"):
        await rig.session.prepare(1, Purpose.RUN)
    probe.rmdir()
    rig.configure(capture={"free_space_bytes": 10**18})
    with raises("disk-full"):
        await rig.session.prepare(1, Purpose.RUN)


@pytest.mark.parametrize("error", [RecordingError(), OSError("gone")])
async def test_a_file_that_cannot_be_begun_is_closed_again(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    closed, close = list[Recorder](), Recorder.close
    monkeypatch.setattr(Recorder, "close", lambda recorder: closed.append(recorder) or close(recorder))
    monkeypatch.setattr("station.session.recording.enter_part", Mock(side_effect=error))
    await rig.go_until(S.IDLE, S.FAULT)
    await until(lambda: rig.arm.log[-1:] == ["end control"])
    assert len(closed) == 1 and rig.session.context.recording is None and "move" not in rig.arm.log


async def test_an_arm_that_was_moved_while_paused_is_not_driven(rig: Rig) -> None:
    await rig.go_until_it_moves()
    await rig.pause_after_this_pose("anna")
    summary = await rig.session.prepare(1, Purpose.RESUME)
    rig.arm.joints = (*rig.arm.joints[:5], rig.arm.joints[5] + 0.3)
    with raises("arm-moved"):
        await rig.session.go(1, summary.token)
    assert rig.state is S.PAUSED


async def test_a_session_cut_by_a_crash_waits_for_a_person_and_goes_on_in_a_new_part(
    new_rig: NewRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = await new_rig()
    await first.go_until_it_moves()
    first.arm.arrive.set()
    await first.until(S.WRITING)
    await first.until(S.MOVING)
    crash(first)

    second = await new_rig(with_plan=False)
    assert second.state is S.STOPPED
    assert second.cause == "interrupted"
    assert second.pose_states == ["done", "planned", "planned", "planned"]
    await asyncio.sleep(0.1)
    assert second.state is S.STOPPED
    second.session.take_lease(1, "anna")
    await second.session.acknowledge("anna")
    assert second.state is S.PAUSED
    await second.go_until(S.IDLE, purpose=Purpose.RESUME)
    recording = sealed(second)
    assert [view.index for view in recording.views()] == list(range(POSES))
    assert second.arm.log.count("move") == POSES - 1
    assert recording.missing == ()
    (recording.path / "session-2.mcap").unlink()
    with pytest.raises(MissingSegmentError):
        open_recording(recording.path)


async def test_the_segment_that_no_reader_takes_is_refused_before_a_move_and_the_session_still_finishes(
    new_rig: NewRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = await new_rig()
    await first.go_until_it_moves()
    first.arm.arrive.set()
    await first.until(S.WRITING)
    await first.until(S.MOVING)
    crash(first)
    second = await new_rig(with_plan=False)
    monkeypatch.setattr("recordings.writer.PARTS_LIMIT", 1)
    second.session.take_lease(1, "anna")
    await second.session.acknowledge("anna")
    await second.go_until(S.PAUSED, purpose=Purpose.RESUME)
    assert second.cause == "too-many-segments"
    assert "move" not in second.arm.log
    await second.session.finish(1)
    assert [view.index for view in sealed(second).views()] == [0]


async def test_a_lost_trigger_box_is_a_fault_of_the_session_until_the_next_go(rig: Rig) -> None:
    """The session's own devices in memory; the camera's box is gone at the first picture."""
    rig.camera.fail = [TriggerError()]
    await rig.go_until(S.FAULT)
    assert rig.session.store.status.cause == "trigger"
    assert "done" not in rig.pose_states
    await rig.session.acknowledge(1)
    await rig.go_until(S.IDLE)
    assert rig.pose_states == ["done"] * len(rig.pose_states)


async def test_17_a_camera_that_loses_the_first_frame_after_a_pause_is_woken(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in Aravis' issue 818; waiting in vain for a frame is a pause, too."""
    capture, glimpse = rig.camera.capture, rig.camera.glimpse
    awake, lost = False, 0

    def triggered() -> bool:
        nonlocal awake
        was_awake, awake = awake, True
        return was_awake

    async def dozing_capture(timeout_s: float = 5.0) -> Image:
        nonlocal awake, lost
        if lost and triggered():
            return await capture(timeout_s)
        lost, awake = lost + 1, False  # the very first one however soon after a glimpse
        raise CameraError()

    async def dozing_glimpse() -> Image:
        if not triggered():
            raise CameraError()
        return await glimpse()

    monkeypatch.setattr(rig.camera, "capture", dozing_capture)
    monkeypatch.setattr(rig.camera, "glimpse", dozing_glimpse)
    await rig.go_until(S.IDLE, S.PAUSED)
    assert rig.pose_states == ["done"] * len(rig.pose_states) and lost == 1


async def test_25_a_pose_whose_time_is_too_uncertain_is_refused(rig: Rig) -> None:
    rig.configure(capture={"time_bound_s": 0.001})  # no clock: ±25 ms
    await rig.go_until(S.PAUSED)
    values = rig.told("time-unsure")[0].values
    assert (values["bound_s"], values["limit_s"]) == (0.025, 0.001)
    assert "done" not in rig.pose_states


async def test_a_pose_that_does_not_come_to_rest_is_offered_to_a_person(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pose 2 rings at its first attempt."""
    glimpse = rig.camera.glimpse

    async def ringing() -> Any:
        session = rig.session.store.status.session
        rig.camera.jumps = 3 if session.current == 1 and session.poses[1].attempt == 1 else 0
        return await glimpse()

    monkeypatch.setattr(rig.camera, "glimpse", ringing)
    await rig.go_until(S.PAUSED)
    assert rig.pose_states == ["done", "failed", "done", "done"]
    assert rig.cause == "unsettled" and rig.told("not-settled")
    moves = rig.arm.log.count("move")
    await rig.session.edit(1, Retake(1))
    assert rig.arm.log.count("move") == moves
    await rig.go_until(S.IDLE, purpose=Purpose.RESUME)
    assert rig.pose_states == ["done"] * POSES
