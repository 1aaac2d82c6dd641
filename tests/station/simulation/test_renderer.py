"""Rendered pictures show the board exactly where OpenCV's projection puts it, and behave like a camera's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibrate.boards.detect import detect
from calibrate.boards.model import board_points, looks_same_turns
from recordings.geometry import Array, rotation_exp
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel
from station.cell.config import PAPER_BOARD
from station.simulation.cells import seen_from
from station.simulation.renderer import Light, render, scaled

CAMERA = CameraModel(
    width=1280,
    height=1024,
    matrix=((1669.8, 0.0, 646.2), (0.0, 1669.4, 505.8), (0.0, 0.0, 1.0)),
    distortion=(-0.11, 0.12, 0.0006, -0.0005, 0.01),
)
SMALL = scaled(CAMERA, 0.25)
NO_NOISE = Light(pixel_noise=0.0)
BOARDS = {
    "chessboard": PAPER_BOARD,
    "charuco": BoardSpec(BoardKind.CHARUCO, 7, 5, 0.03, marker_m=0.022, dictionary="DICT_5X5_100"),
    "charuco legacy": BoardSpec(
        BoardKind.CHARUCO, 6, 6, 0.03, marker_m=0.022, dictionary="DICT_4X4_50", legacy=True
    ),
    "circles": BoardSpec(BoardKind.CIRCLES, 8, 6, 0.025),
    "asymmetric circles": BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, 4, 11, 0.018),
    "april grid": BoardSpec(BoardKind.APRIL_GRID, 5, 4, 0.035, marker_m=0.0105),
}


def projected(board: BoardSpec, camera_from_board: Array, camera: CameraModel = CAMERA) -> Array:
    """The oracle."""
    rotation, _ = cv2.Rodrigues(camera_from_board[:3, :3])
    lens = rotation, camera_from_board[:3, 3], np.array(camera.matrix), np.array(camera.distortion)
    if camera.distortion_model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(board_points(board)[None], *lens)
    else:
        pixels, _ = cv2.projectPoints(board_points(board), *lens)
    return np.asarray(pixels.reshape(-1, 2))


def varied_views(board: BoardSpec, count: int, seed: int) -> list[Array]:
    rng = np.random.default_rng(seed)
    views = []
    for _ in range(count):
        turn = rotation_exp(np.array([*rng.uniform(-0.5, 0.5, 2), 0.0])) @ rotation_exp(
            [0, 0, rng.uniform(-3, 3)]
        )
        view = seen_from(board, rng.uniform(0.45, 0.6), turn)
        view[:2, 3] += rng.uniform(-0.04, 0.04, 2)
        views.append(view)
    return views


def test_corners_lie_where_opencv_projects_them_without_bias() -> None:
    errors = []
    rng = np.random.default_rng(5)
    for view in varied_views(PAPER_BOARD, 12, seed=1):
        picture = render(CAMERA, PAPER_BOARD, view, Light(pixel_noise=0.3), rng)
        truth = projected(PAPER_BOARD, view)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-6)
        start = truth.astype(np.float32).reshape(-1, 1, 2) + np.float32(0.4)
        found = cv2.cornerSubPix(picture, start, (6, 6), (-1, -1), stop).reshape(-1, 2)
        errors.append(found - truth)
    error = np.concatenate(errors)
    assert np.abs(error.mean(axis=0)).max() < 0.004
    assert np.sqrt((error**2).mean()) < 0.03


def test_rows_of_the_board_along_the_pixel_rows_are_as_exact_as_others() -> None:
    """There all samples of an edge would pass at once, were they a square grid."""
    errors = []
    for k in range(3):
        view = seen_from(
            PAPER_BOARD, 0.45 + 0.013 * k, rotation_exp([0.34 * np.cos(k), 0.34 * np.sin(k), 0.0])
        )
        seen = detect(render(CAMERA, PAPER_BOARD, view, NO_NOISE), PAPER_BOARD)
        assert seen.found
        truth = projected(PAPER_BOARD, view)
        errors.append(min((seen.corners.pixels - t for t in (truth, truth[::-1])), key=np.linalg.norm))
    assert np.sqrt((np.concatenate(errors) ** 2).mean()) < 0.03


FISHEYE = CameraModel(
    width=1280,
    height=1024,
    matrix=((1300.0, 0.0, 646.2), (0.0, 1300.0, 505.8), (0.0, 0.0, 1.0)),
    distortion=(-0.03, 0.01, 0.0, 0.0),
    distortion_model="equidistant",
)


@pytest.mark.parametrize(("name", "lens"), [*((name, CAMERA) for name in BOARDS), ("chessboard", FISHEYE)])
def test_every_board_is_detected_where_it_is(name: str, lens: CameraModel) -> None:
    board = BOARDS[name]
    for view in varied_views(board, 2, seed=3):
        picture = render(lens, board, view, Light(pixel_noise=1.0), np.random.default_rng(2))
        seen = detect(picture, board)
        assert seen.found, seen.reason
        truth = projected(board, view, lens)
        # A grid that looks the same upside down may be read from its other end.
        orders = [truth, truth[::-1]] if 2 in looks_same_turns(board) else [truth]
        error = min((seen.corners.pixels - points[seen.corners.ids] for points in orders), key=np.linalg.norm)
        # Centres of circles are seen a little off by perspective; everything else is exact.
        assert np.sqrt((error**2).mean()) < (0.25 if "circles" in name else 0.12)


def test_noise_has_the_stated_sigma_and_grows_with_gain() -> None:
    view = seen_from(PAPER_BOARD, 0.6)
    for gain_db in (0.0, 6.0):
        light = Light(exposure_us=4000, gain_db=gain_db, pixel_noise=3.0)
        first, second = (render(SMALL, PAPER_BOARD, view, light, np.random.default_rng(s)) for s in (1, 2))
        table = np.s_[:40, :]
        sigma = (first[table].astype(float) - second[table]).std() / np.sqrt(2)
        assert sigma == pytest.approx(3.0 * 10 ** (gain_db / 20), rel=0.05)
    same = render(SMALL, PAPER_BOARD, view, light, np.random.default_rng(2))
    assert np.array_equal(second, same)
