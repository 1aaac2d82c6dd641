"""A session whose trigger box fails, or whose camera loses what it is triggered for."""

from __future__ import annotations

import asyncio
import time

import pytest

from recordings.schema.messages import Image
from station.cell.errors import CameraError, TriggerError
from station.cell.status import StationState as S
from tests.station.session_rig import Rig


async def test_a_lost_trigger_box_is_a_fault_of_the_session_until_the_next_go(rig: Rig) -> None:
    """The session's own devices in memory; the camera's box is gone at the first picture."""
    capture = rig.camera.capture
    gone = [TriggerError()]

    async def with_box(timeout_s: float = 5.0) -> Image:
        if gone:
            raise gone.pop()
        return await capture(timeout_s)

    rig.camera.capture = with_box  # type: ignore[method-assign]
    await rig.give_go()
    await rig.until(S.FAULT)
    assert rig.session.store.status.cause == "trigger"
    assert "done" not in rig.pose_states
    await rig.session.acknowledge(1)
    await rig.give_go()
    await rig.until(S.IDLE)
    assert rig.pose_states == ["done"] * len(rig.pose_states)


async def test_17_a_camera_that_loses_the_first_frame_after_a_pause_is_woken(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in Aravis' issue 818; waiting in vain for a frame is a pause, too."""
    capture, glimpse = rig.camera.capture, rig.camera.glimpse
    awake_until_s, lost = 0.0, 0

    def triggered() -> bool:
        nonlocal awake_until_s
        was_awake = time.monotonic() < awake_until_s
        awake_until_s = time.monotonic() + 0.2
        return was_awake

    async def dozing_capture(timeout_s: float = 5.0) -> Image:
        nonlocal lost
        if lost and triggered():
            return await capture(timeout_s)
        lost += 1  # the very first one however soon after a glimpse
        await asyncio.sleep(0.3)
        raise CameraError()

    async def dozing_glimpse() -> Image:
        if not triggered():
            raise CameraError()
        return await glimpse()

    monkeypatch.setattr(rig.camera, "capture", dozing_capture)
    monkeypatch.setattr(rig.camera, "glimpse", dozing_glimpse)
    await rig.give_go()
    await rig.until(S.IDLE, S.PAUSED)
    assert rig.pose_states == ["done"] * len(rig.pose_states) and lost == 1
