"""The picture has a say in what rests: a pose whose camera still rings is not captured."""

from __future__ import annotations

import asyncio
import gc
from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings.reader import open_recording
from station.analysis.worker import board_box, image_motion
from station.cell.errors import CameraError
from station.cell.pose_plan import ExpectedView
from station.cell.status import StationState as S
from station.session.capture import ImageWatch
from tests.patience import until
from tests.station.session_rig import POSES, Rig

SCENE = cv2.GaussianBlur(np.random.default_rng(4).normal(128, 150, (600, 760)), (0, 0), 1.5)


def seen(right_px: float = 0.0, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """A window of one scene, 640 × 480, shifted and noisy."""
    shift = np.array([[1.0, 0.0, -60.0 + right_px], [0.0, 1.0, -60.0]])
    picture = cv2.warpAffine(SCENE, shift, (640, 480), flags=cv2.INTER_CUBIC)
    noisy = picture + np.random.default_rng(seed).normal(0, noise, picture.shape) if noise else picture
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shift_px", [0.0, 0.3, 1.0, 7.5, 40.0])
def test_the_shift_between_noisy_pictures_is_measured(shift_px: float) -> None:
    pictures = [seen(0.0, 7.0, 1), seen(0.0, 7.0, 2), seen(shift_px, 7.0, 3)]
    motion_px = image_motion(pictures)
    assert motion_px == pytest.approx(shift_px, abs=0.3 if shift_px else 0.05)
    assert image_motion(pictures, full_width=1280) == pytest.approx(2 * (motion_px or 0))


@pytest.mark.parametrize("size", [(122, 122), (225, 135), (130, 243)])
def test_nothing_moves_in_images_of_any_size(size: tuple[int, int]) -> None:
    """OpenCV's correlation is half a pixel off where a side's Fourier transform has an odd length."""
    rows, columns = size
    assert image_motion([seen(0.0, 7.0, k)[:rows, :columns] for k in (1, 2, 3)]) == pytest.approx(
        0.0, abs=0.1
    )


def test_a_ringing_that_fits_one_gap_shows_in_the_other() -> None:
    assert image_motion([seen(3.0), seen(0.0), seen(0.0)]) == pytest.approx(3.0, abs=0.15)
    assert image_motion([seen(0.0), seen(3.0), seen(0.0)]) == pytest.approx(3.0, abs=0.15)


def test_every_kind_of_picture_is_understood() -> None:
    pair = [seen(0.0), seen(5.0)]
    colour = [cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) for picture in pair]
    for images in (colour, [picture.astype(np.uint16) << 8 for picture in pair]):
        assert image_motion(images) == pytest.approx(5.0, abs=0.15)


def test_a_flat_picture_says_nothing() -> None:
    noise = np.random.default_rng(5).normal(90, 2, (2, 480, 640)).clip(0, 255).astype(np.uint8)
    assert image_motion(list(noise)) is None


def test_a_board_that_swings_before_a_resting_wall_is_seen_where_it_should_be() -> None:
    pair = [seen(), seen()]
    for x, picture in zip((200, 206), pair, strict=True):
        picture[160:280, x : x + 160] = 255 - seen()[160:280, 200:360] // 2
    box = board_box(ExpectedView(0.8, 0.0, 0.0, (280.0, 220.0), 120 * 160 / (640 * 480)), 640, 480)
    assert image_motion(pair, 640, box) == pytest.approx(6.0, abs=0.8)


async def recorded(rig: Rig) -> list[float | None]:
    """Image motion of every pose of a whole session."""
    await rig.go_until(S.IDLE, S.PAUSED, S.FAULT)
    views = open_recording(Path(rig.session.store.status.session.recording)).views()
    return [view.stillness.image_motion_px for view in views if view.stillness is not None]


@pytest.mark.parametrize(
    ("fails", "motion_px"), [([], 0.0), (["incomplete"], 0.0), (["no frame"] * 2 * POSES, None)]
)
async def test_every_pose_is_recorded_with_its_pictures_motion_where_it_was_measured(
    rig: Rig, fails: list[str], motion_px: float | None
) -> None:
    rig.camera.glimpse_fails = list(fails)
    assert await recorded(rig) == [motion_px] * POSES
    assert len(rig.told("camera")) == (POSES if motion_px is None else 0)


async def test_it_is_captured_as_soon_as_the_picture_rests(rig: Rig) -> None:
    rig.camera.jumps = 3
    await rig.give_go()
    await until(lambda: rig.camera.glimpses > 3)
    assert rig.camera.taken == 0
    rig.camera.jumps = 0
    await rig.until(S.IDLE)
    assert rig.pose_states == ["done"] * POSES


async def test_stop_leaves_the_camera_free(rig: Rig) -> None:
    rig.camera.jumps = 3
    await rig.go_until(S.SETTLING)
    await rig.session.stop("bert")
    seen_before = rig.camera.glimpses
    await asyncio.sleep(0.1)
    assert rig.camera.glimpses == seen_before and rig.state is S.STOPPED


async def test_a_camera_that_fails_when_nobody_looks_any_more_is_no_traceback(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    given_up, logged = asyncio.Event(), []

    async def hangs() -> None:
        await given_up.wait()
        raise CameraError()

    asyncio.get_running_loop().set_exception_handler(lambda loop, context: logged.append(context))
    monkeypatch.setattr(rig.camera, "glimpse", hangs)
    async with ImageWatch(rig.session.context, 0):
        await asyncio.sleep(0.01)
        asyncio.get_running_loop().call_later(0.05, given_up.set)  # the pose ends before that
    gc.collect()
    await asyncio.sleep(0)
    assert logged == []
