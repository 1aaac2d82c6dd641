"""What was measured of one board in one image: selected, scaled, placed, and checked by its view."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calibrate.errors import BadViewsError
from calibrate.handeye import BoardView, Corners
from tests.codes import raises

BOARD = np.array([[x, y, 0.0] for y in range(4) for x in range(5)]) * 0.02
RNG = np.random.default_rng(0)
SEEN = np.array([2, 3, 7, 8, 19])
SOME = Corners(BOARD[SEEN], RNG.uniform(0, 400, (5, 2)), SEEN, board="left", camera="wrist")


def test_a_part_knows_the_same_board_camera_and_rows() -> None:
    for places in ([4, 0], slice(1, 3), SEEN > 5):
        part = SOME.part(places)
        np.testing.assert_array_equal(part.points, BOARD[part.ids])
        np.testing.assert_array_equal(part.pixels, SOME.pixels[places])
        assert (part.board, part.camera, len(part)) == ("left", "wrist", len(part.ids))


def test_they_are_placed_on_the_board_as_it_is_measured_later() -> None:
    larger = SOME.placed(1.05 * BOARD)
    np.testing.assert_allclose(larger.points, 1.05 * SOME.points)
    np.testing.assert_array_equal(larger.pixels, SOME.pixels)


def test_the_middle_of_the_first_pixel_is_scaled_about_the_images_corner() -> None:
    first = Corners(np.zeros((1, 3)), np.array([[0.0, 0.0]]))
    assert first.scaled(2.0).pixels.tolist() == [[0.5, 0.5]]
    np.testing.assert_allclose(SOME.scaled(4.0).scaled(0.25).pixels, SOME.pixels)


def test_all_points_are_meant_where_no_rows_are_given() -> None:
    view = BoardView(0, "a", np.eye(4), Corners(BOARD, np.zeros((20, 2))))
    assert view.corners.ids.tolist() == list(range(20))


@pytest.mark.parametrize(
    ("points", "pixels", "ids", "wrong"),
    [
        (BOARD[:, :2], np.zeros((20, 2)), (), "points"),
        (BOARD, np.zeros((20, 3)), (), "pixels"),
        (BOARD, None, (), "pixels"),
        (BOARD, 5.0, (), "pixels"),
        (BOARD, np.zeros((20, 2)), np.arange(19), "ids"),
        (BOARD, np.zeros((20, 2)), np.arange(20) / 2, "ids"),
    ],
)
def test_a_view_names_itself_where_its_corners_cannot_be(
    points: Any, pixels: Any, ids: Any, wrong: str
) -> None:
    with raises("shape", BadViewsError, what=f"{wrong} of view 3 (tilted)"):
        BoardView(2, "tilted", np.eye(4), Corners(points, pixels, ids))
