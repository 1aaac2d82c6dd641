"""The exposure assistant leads any start to a well exposed board, and names what is wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrate.boards.model import board_points
from recordings.geometry import Array, transform_points
from recordings.schema.messages import CameraModel
from station.analysis.worker import ExposureAdvice, assess
from station.cell.config import PAPER_BOARD
from station.simulation.cells import seen_from
from station.simulation.renderer import Light, render

CAMERA = CameraModel(320, 256, ((417.0, 0.0, 159.5), (0.0, 417.0, 127.5), (0.0, 0.0, 1.0)))
VIEW = seen_from(PAPER_BOARD, 0.5)


def corners() -> Array:
    seen = transform_points(VIEW, board_points(PAPER_BOARD))
    return np.asarray(seen[:, :2] / seen[:, 2:] * 417.0 + [159.5, 127.5])


def look(exposure_us: float, gain_db: float, light: float = 1.0, **other: float) -> ExposureAdvice:
    settings = Light(exposure_us=exposure_us, gain_db=gain_db, illumination=light, **other)
    picture = render(CAMERA, PAPER_BOARD, VIEW, settings, np.random.default_rng(1))
    return assess(picture, corners(), exposure_us, gain_db)


@settings(max_examples=25)
@given(st.floats(60.0, 40_000.0), st.floats(0.0, 12.0), st.floats(0.4, 4.0))
def test_following_the_advice_ends_at_a_well_exposed_board(
    exposure_us: float, gain_db: float, light: float
) -> None:
    for _ in range(6):
        advice = look(exposure_us, gain_db, light)
        exposure_us, gain_db = advice.exposure_us, advice.gain_db
    assert look(exposure_us, gain_db, light).cause == ""


def test_gain_is_raised_only_where_exposure_is_used_up() -> None:
    assert look(2000, 0.0).gain_db == 0.0
    dim = look(10_000, 0.0, light=0.08)
    assert dim.exposure_us == 40_000 and dim.gain_db > 0
    assert look(5000, 12.0, light=2.0).gain_db < 12.0


@pytest.mark.parametrize(
    ("picture", "cause"),
    [
        ({}, ""),
        ({"light": 4.0}, "over-exposed"),
        ({"light": 0.1}, "under-exposed"),
        ({"blur_px": 3.0}, "blurred"),
    ],
)
def test_what_is_wrong_is_named_and_only_the_light_is_changed(picture: dict[str, float], cause: str) -> None:
    advice = look(10_000, 0.0, **picture)
    kept = (advice.exposure_us, advice.gain_db) == (10_000, 0.0)
    assert advice.cause == cause and kept == (cause in ("", "blurred")) and bool(advice.text) == bool(cause)


def test_deep_and_colour_pictures_count_the_same() -> None:
    picture = render(CAMERA, PAPER_BOARD, VIEW, Light(pixel_noise=0.0, illumination=4.0))
    plain = assess(picture, None, 10_000, 0.0)
    assert plain.cause == "over-exposed"
    assert assess(picture.astype(np.uint16) << 4, None, 10_000, 0.0).exposure_us == plain.exposure_us
    assert assess(np.repeat(picture[:, :, None], 3, axis=2), None, 10_000, 0.0) == plain
