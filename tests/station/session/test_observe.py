"""A picture for the touch test: between sessions, of an arm at rest, with its pose; nothing is kept."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import msgspec
import numpy as np
import pytest

from calibrate.boards.detect import Detection
from calibrate.boards.model import board_points
from calibrate.views.corners import Corners
from recordings.errors import CodedError
from recordings.geometry import base_from_flange
from recordings.schema.messages import BoardKind, BoardSpec, Image, Stamps
from station.analysis.pool import WorkerError
from station.cell.errors import CameraError
from station.cell.status import NO_IMAGE, NOT_LOOKED
from station.cell.status import StationState as S
from station.protocol.verbs import Purpose
from station.session import previews
from tests.codes import raises
from tests.patience import until
from tests.station.session_rig import NewRig, Rig

TAG = BoardSpec(BoardKind.APRIL_TAG, square_m=0.05)


@pytest.fixture(autouse=True)
def tag_in_sight(monkeypatch: pytest.MonkeyPatch) -> None:
    points = board_points(TAG)
    seen = Detection("", "", Corners(points, 100 + 2000 * points[:, :2]), len(points), 1280, 1024, 0.0, 0.1)
    monkeypatch.setattr(previews, "detect", lambda *args: seen)


async def test_corners_and_the_arms_pose_of_mid_exposure_without_control_or_session(rig: Rig) -> None:
    rig.arm.rest()
    told: list[int] = []
    at = rig.arm.at
    rig.arm.at = lambda ns: told.append(ns) or at(ns)
    found = await rig.session.previews.observe(TAG)
    state = rig.arm.state()
    assert found.corners == (0, 1, 2, 3)
    assert np.allclose(found.base_from_flange, base_from_flange(state.tcp_pose, rig.arm.identity.tcp_offset))
    assert len(told) == 1 and rig.camera.taken == 1
    assert rig.arm.log == [] and rig.state is S.IDLE
    assert not list(rig.session.context.root.rglob("*.mcap*"))


async def test_no_picture_of_an_arm_that_moves_or_of_a_session_is_told(rig: Rig) -> None:
    rig.arm.rest()
    at, state = rig.arm.at, rig.arm.state()
    rig.arm.at = lambda ns: msgspec.structs.replace(at(ns), joint_speeds_rad_s=(0.1,) * 6)
    with raises("moved-in-exposure"):
        await rig.session.previews.observe(TAG)
    taken, later_s = rig.camera.taken, state.stamps.controller_s + 0.008
    stamps = msgspec.structs.replace(state.stamps, controller_s=later_s)
    rig.session.context.stillness.add(
        msgspec.structs.replace(state, stamps=stamps, joint_speeds_rad_s=(0.1,) * 6)
    )
    with raises("arm-moves"):
        await rig.session.previews.observe(TAG)
    await rig.go_until_it_moves()
    with raises("wrong-state"):
        await rig.session.previews.observe(TAG)
    assert rig.camera.taken == taken
    await rig.pause_after_this_pose("anna")
    with raises("wrong-state"):  # its recording is open
        await rig.session.previews.observe(TAG)


async def test_a_crowd_that_asks_delays_a_session_by_one_picture(
    rig: Rig, held_camera: asyncio.Event
) -> None:
    rig.arm.rest()
    summary = await rig.session.prepare(1, Purpose.RUN)
    crowd = [asyncio.create_task(rig.session.previews.observe(TAG)) for _ in range(20)]
    await asyncio.sleep(0)
    rig.arm.slow = True
    await rig.session.go(1, summary.token)
    await rig.until(S.MOVING)
    held_camera.set()
    answers: list[Any] = await asyncio.gather(*crowd, return_exceptions=True)
    assert {getattr(answer, "code", "") for answer in answers} == {"wrong-state"}
    assert rig.camera.taken == 1 and all(isinstance(answer, CodedError) for answer in answers)


async def test_what_cannot_be_looked_for_is_refused_before_a_picture(rig: Rig, new_rig: NewRig) -> None:
    with raises("board-impossible"):
        await rig.session.previews.observe(BoardSpec(BoardKind.APRIL_TAG))
    played = await new_rig(with_plan=False, source="playback")
    await played.until(S.IDLE)
    with raises("played"):
        await played.session.previews.observe(TAG)
    assert rig.camera.taken == played.camera.taken == 0


async def test_a_silent_camera_is_told_and_one_lost_frame_is_not(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def silent() -> None:
        raise CameraError("no-image", limit_s=1.0)

    look, told = rig.session.previews.look, lambda: rig.session.store.status.detection.cause == NO_IMAGE
    monkeypatch.setattr(previews, "PREVIEW_PERIOD_S", 0.0)
    await look()
    monkeypatch.setattr(rig.camera, "glimpse", silent)
    monkeypatch.setattr(previews, "OLD_S", 60.0)
    await look()
    assert not told()
    monkeypatch.setattr(previews, "OLD_S", 0.0)
    assert await look() is None
    await until(told)


@pytest.mark.parametrize("worker", ["slow", "hangs"])
async def test_where_no_board_was_looked_for_none_is_told_and_the_image_goes_on(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, worker: str
) -> None:
    """What was seen minutes ago stood under a new image: corners 42/42, and the board was not in it."""
    call, go_on, calls = rig.worker.call, asyncio.Event(), []

    async def slow(*arguments: Any, **named: Any) -> Any:
        calls.append(arguments)
        await go_on.wait()
        if worker == "hangs":
            raise WorkerError("worker-late", function="sight")
        return await call(*arguments, **named)

    monkeypatch.setattr(previews, "PREVIEW_PERIOD_S", 0.0)
    store = rig.session.store
    first = await rig.session.previews.preview(64, 64)
    assert store.status.detection.found and first.corners
    monkeypatch.setattr(rig.worker, "call", slow)
    monkeypatch.setattr(previews, "LOOK_S", 0.0)
    monkeypatch.setattr(previews, "OLD_S", 0.0)
    second = await rig.session.previews.preview(64, 64)
    third = await rig.session.previews.preview(64, 64)
    assert first.sequence < second.sequence < third.sequence and not (second.corners or third.corners)
    assert store.status.detection.cause == NOT_LOOKED and not store.status.detection.found
    assert len(calls) == 1, "a slow worker is not asked again meanwhile, nor started anew"
    waiting = asyncio.create_task(rig.session.previews.look())
    await asyncio.sleep(0)
    monkeypatch.setattr(previews, "OLD_S", 60.0)
    go_on.set()
    assert (await waiting is None) is (worker == "hangs"), "who needs the board waits for it"
    monkeypatch.setattr(previews, "LOOK_S", 60.0)
    await rig.session.previews.preview(64, 64)
    if worker == "slow":
        assert store.status.detection.found


async def test_a_screen_that_closes_takes_no_look_from_the_others(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As nothing but the worker's end would end what it does for a call that nobody wants."""
    call, asked, ended, answer = rig.worker.call, asyncio.Event(), [], asyncio.Event()

    async def slow(*arguments: Any, **named: Any) -> Any:
        asked.set()
        try:
            await answer.wait()
        finally:
            ended.append(answer.is_set())
        return await call(*arguments, **named)

    monkeypatch.setattr(rig.worker, "call", slow)
    closing = asyncio.create_task(rig.session.previews.preview(64, 64))
    await asked.wait()
    closing.cancel()
    await asyncio.wait({closing})
    answer.set()
    await until(lambda: ended)
    assert ended == [True]


async def test_what_was_seen_ends_by_itself_where_nobody_asks_and_with_its_picture(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`station status` told the corners of minutes ago where no screen asked for pictures."""
    status = lambda: rig.session.store.status.detection  # noqa: E731
    assert status().cause == NOT_LOOKED, "nothing was looked at yet"
    first = await rig.session.previews.preview(64, 64)
    assert status().found and first.corners and first.age_s < 1.0
    monkeypatch.setattr(previews, "PREVIEW_PERIOD_S", 3600.0)
    monkeypatch.setattr(previews.time, "monotonic", lambda before=time.monotonic: before() + 60.0)
    late = await rig.session.previews.preview(64, 64)
    assert late.sequence == first.sequence and late.age_s > 59.0 and not late.corners
    assert await rig.session.previews.look() is None, "nobody is guided by an old picture"
    await until(lambda: status().cause == NOT_LOOKED)


async def test_while_the_worker_is_at_other_work_the_picture_goes_on_and_says_so(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(previews, "PREVIEW_PERIOD_S", 0.0)
    first = await rig.session.previews.preview(64, 64)
    rig.worker.waiting = 1
    monkeypatch.setattr(previews, "OLD_S", 0.0)
    second = await rig.session.previews.preview(64, 64)
    assert second.sequence > first.sequence and not second.corners
    assert await rig.session.previews.look() is None
    rig.worker.waiting = 0


async def test_after_a_slow_search_a_smaller_picture_is_searched_and_that_is_said(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that was only slow was killed and started anew every six seconds."""
    call, sides, clock = rig.worker.call, [], [0.0]

    async def noted(function: Any, *arguments: Any, **named: Any) -> Any:
        sides.append(arguments[0].shape[1])
        clock[0] += 1.0 if arguments[0].shape[1] > 1024 else 0.01
        return await call(function, *arguments, **named)

    async def large() -> Image:
        return Image(np.zeros((1600, 2000), np.uint8), Stamps(), 0, 0)

    monkeypatch.setattr(previews, "PREVIEW_PERIOD_S", 0.0)
    monkeypatch.setattr(previews.time, "monotonic", lambda: 1000.0 + clock[0])
    monkeypatch.setattr(rig.camera, "glimpse", large)
    monkeypatch.setattr(rig.worker, "call", noted)
    said = []
    for _ in range(4):
        await rig.session.previews.look()
        said.append(rig.session.store.status.detection.advice == previews.BUSY)
    assert sides == [2000, 1024, 2000, 1024] and said == [True, False, True, False]
