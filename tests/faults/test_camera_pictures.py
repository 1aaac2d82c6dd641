"""Faults 23 and 26: changed settings and pictures that show the board badly are refused with the reason."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from calibrate.boards.detect import detect
from recordings.schema.messages import BoardKind, BoardSpec
from station.analysis.worker import assess
from station.cell.config import PAPER_BOARD
from station.simulation.camera import RenderedCamera
from tests.codes import raises

pytestmark = pytest.mark.process


async def test_23_a_camera_that_changes_its_exposure_is_refused(camera: RenderedCamera) -> None:
    await camera.capture()
    await camera.inject("exposure", 7000)
    with raises("settings-changed"):
        await camera.capture()
    await camera.inject("exposure")
    await camera.capture()


@pytest.mark.parametrize(
    ("fault", "value", "words"),
    [
        ("cover", 0.5, "board"),
        ("board", msgspec.to_builtins(BoardSpec(BoardKind.CHESSBOARD, 8, 5, 0.025)), "8×5"),
    ],
)
async def test_26_a_hidden_or_wrong_board_is_not_found_and_the_reason_is_said(
    camera: RenderedCamera, fault: str, value: Any, words: str
) -> None:
    assert detect((await camera.capture()).pixels, PAPER_BOARD).found
    await camera.inject(fault, value)
    seen = detect((await camera.capture()).pixels, PAPER_BOARD)
    assert not seen.found and words in seen.reason


@pytest.mark.parametrize(("light", "cause"), [(4.0, "over-exposed"), (0.08, "under-exposed")])
async def test_26_over_and_under_exposure_are_named_with_what_to_set(
    camera: RenderedCamera, light: float, cause: str
) -> None:
    good = await camera.capture()
    assert assess(good.pixels, None, good.exposure_us, good.gain_db).cause == ""
    await camera.inject("illumination", light)
    bad = await camera.capture()
    advice = assess(bad.pixels, None, bad.exposure_us, bad.gain_db)
    assert advice.cause == cause
    assert (advice.exposure_us < bad.exposure_us) == (light > 1)
