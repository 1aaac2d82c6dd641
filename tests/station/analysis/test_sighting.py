"""What previews tell the screen: the exposure assistant's advice, distance and tilt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import recordings
from calibrate.boards.detect import Detection
from calibrate.boards.model import board_points
from calibrate.views.corners import Corners
from calibrate.views.projection import project
from recordings.geometry import transform_points
from recordings.reader import open_recording
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel
from station.analysis import worker
from station.analysis.estimation import seen_before
from station.analysis.worker import detection_status, sight
from station.cell.config import PAPER_BOARD
from station.simulation.cells import make_cell, seen_from
from station.simulation.renderer import Light, render, scaled


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_the_distance_is_the_same_in_a_preview_of_half_the_size(factor: float) -> None:
    camera = make_cell("paper", 0, "low", "eye-in-hand").camera
    view = seen_from(PAPER_BOARD, 0.5)
    picture = render(scaled(camera, factor), PAPER_BOARD, view, Light(), np.random.default_rng(0))
    status = detection_status(sight(picture, PAPER_BOARD, camera, False))
    assert status.distance_m == pytest.approx(0.5, abs=0.005)


OTHER = BoardSpec(BoardKind.CHESSBOARD, columns=9, rows=6, square_m=0.025)


@pytest.mark.parametrize(
    ("cause", "light", "board", "aside_m"),
    [
        ("", Light(), PAPER_BOARD, 0.0),
        ("over-exposed", Light(exposure_us=60_000.0), PAPER_BOARD, 0.0),
        ("under-exposed", Light(exposure_us=1_500.0), PAPER_BOARD, 0.22),
        ("under-exposed", Light(exposure_us=1_500.0), PAPER_BOARD, 0.0),
        ("blurred", Light(blur_px=6.0), PAPER_BOARD, 0.0),
        ("too-dark", Light(exposure_us=100.0), PAPER_BOARD, 0.0),
        ("other-board", Light(exposure_us=1_500.0), OTHER, 0.0),
    ],
)
def test_light_is_the_cause_unless_something_else_is(
    cause: str, light: Light, board: BoardSpec, aside_m: float
) -> None:
    view = seen_from(PAPER_BOARD, 0.5)
    view[0, 3] += aside_m
    picture = render(make_cell("paper-binned").camera, PAPER_BOARD, view, light, np.random.default_rng(0))
    status = detection_status(sight(picture, board, None, exposure=(light.exposure_us, 0.0)))
    assert status.cause == cause and bool(status.advice) == (light != Light())
    assert not detection_status(sight(picture, board, None, False)).advice, "an image of unknown exposure"


def test_distance_and_tilt_are_those_by_a_fisheye_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    lens = CameraModel(
        640, 512, ((250.0, 0, 320), (0, 250.0, 256), (0, 0, 1)), (0.2, -0.1, 0.0, 0.0), "equidistant"
    )
    points, C = board_points(PAPER_BOARD), seen_from(PAPER_BOARD, 0.2)
    pixels = project(lens, transform_points(C, points)).pixels
    seen = Detection("", "", Corners(points, pixels), len(points), 640, 512, 0.0, 0.5)
    monkeypatch.setattr(worker, "detect", lambda *_, **__: seen)
    status = detection_status(sight(np.zeros((512, 640), np.uint8), PAPER_BOARD, lens, False))
    assert status.distance_m == pytest.approx(0.2, abs=1e-4)
    assert status.tilt_rad == pytest.approx(float(np.arccos(C[2, 2])), abs=1e-3)


def test_the_pictures_of_a_recording_are_seen_again_with_their_poses() -> None:
    path = Path(recordings.__file__).parent / "samples" / "paper-640.mcap"
    recording = open_recording(path)
    found = seen_before(path, recording.info.board)
    assert [seen.index for seen in found] == [view.index for view in recording.views()]
    for seen, view in zip(found, recording.views(), strict=True):
        assert np.array_equal(seen.base_from_flange, view.base_from_flange)
        assert len(seen.corners.ids) == len(seen.corners) == 42
