"""The operator guides the arm by hand, the station guides and records."""

from __future__ import annotations

import asyncio
import contextlib

import pytest

from recordings.errors import RecordingError
from recordings.schema.messages import Image
from station.cell.errors import RefusedError, TriggerError
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose
from station.session.queue import PoseQueue
from station.session.recording import SessionRecording
from tests.codes import raises
from tests.station.session_rig import Rig


@pytest.mark.parametrize("broken", [TriggerError(), ZeroDivisionError("a defect")])
async def test_a_picture_that_ends_oddly_leaves_no_state_of_work(bare_rig: Rig, broken: Exception) -> None:
    bare_rig.arm.rest()
    await bare_rig.session.switch_free_drive(1, True)
    bare_rig.camera.fail = [broken]
    with contextlib.suppress(type(broken)):
        await bare_rig.session.record(1)
    assert bare_rig.state is S.FAULT
    assert str(broken.args[0]) in bare_rig.session.store.status.reason
    assert bare_rig.pose_states == ["planned"]


async def test_free_drive_does_not_begin_beside_a_picture_that_a_lost_lease_left(
    bare_rig: Rig, held_camera: asyncio.Event
) -> None:
    rig = bare_rig
    await rig.session.switch_free_drive(1, True)
    taking = asyncio.ensure_future(rig.session.record(1))
    await rig.until(S.CAPTURING)
    await rig.session.lease_lost(1)
    rig.session.take_lease(1, "anna")
    with raises("still-ending"):
        await rig.session.switch_free_drive(1, True)
    held_camera.set()
    await taking
    await rig.session.switch_free_drive(1, True)
    assert rig.state is S.FREE_DRIVE


@pytest.mark.parametrize("fails", [False, True])
async def test_while_free_drive_begins_no_go_is_given_and_stop_leaves_a_way_on(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    disk, opening = asyncio.Event(), SessionRecording.open

    async def slow(recording: SessionRecording, queue: PoseQueue, picture: Image | None = None) -> None:
        await disk.wait()
        if fails:
            raise RecordingError()
        await opening(recording, queue, picture)

    monkeypatch.setattr(SessionRecording, "open", slow)
    beginning = asyncio.ensure_future(rig.session.switch_free_drive(1, True))
    await rig.until(S.FREE_DRIVE)
    with raises("wrong-state"):
        await rig.session.prepare(1, Purpose.RUN)
    await rig.session.stop("bert")
    assert rig.state is S.STOPPED and rig.session.context.requests.halt
    await rig.session.acknowledge("anna")
    disk.set()
    with pytest.raises(RecordingError if fails else RefusedError):
        await beginning
    assert (rig.state, rig.session.context.recording is None) == (
        (S.IDLE, True) if fails else (S.PAUSED, False)
    )
    if not fails:
        await rig.session.finish(1)  # in idle it was refused, and so was every plan
        assert rig.state is S.IDLE


async def test_stop_before_free_drive_has_begun_stays_latched(bare_rig: Rig) -> None:
    bare_rig.arm.late = True
    beginning = asyncio.ensure_future(bare_rig.session.switch_free_drive(1, True))
    await asyncio.sleep(0.02)
    await bare_rig.session.stop("bert")
    bare_rig.arm.late = False
    with raises("wrong-state"):
        await beginning
    assert bare_rig.state is S.STOPPED
