"""A board that was measured wrongly is found by the robot's motion, with its size and how sure that is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate.scale import check_scale
from calibrate.views import ViewSet
from recordings.messages import BoardKind, BoardSpec
from tests.calibrate.cells import MID, Noise, make_cell

BOARD = BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025)


def as_if_measured(views: ViewSet, scale: float) -> ViewSet:
    """What a true size of `scale` times the configured one does: everything seen looks nearer by it."""

    def smaller(view):
        seen = view.camera_from_board.copy()
        seen[:3, 3] /= scale
        return replace(view, board_points=view.board_points / scale, camera_from_board=seen)

    return replace(views, views=tuple(map(smaller, views)))


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("scale", [0.96, 1.0, 1.03])
def test_the_size_of_a_square_is_found(mount, scale):
    cell = make_cell(np.random.default_rng(3), 10, Noise(0.0, 0.0, 0.0), mount=mount, with_pnp=False)
    check = check_scale(as_if_measured(cell.views, scale), cell.X[:3, :3], BOARD)
    assert check is not None
    assert check.scale == pytest.approx(scale, abs=1e-9)
    assert check.square_m == pytest.approx(0.025 * scale)
    assert check.text.startswith(f"Squares of {25 * scale:.3f} ± 0.000 mm fit the robot's motion, 25 mm are")
    assert ("Measure the board" in check.text) == (scale != 1.0)


def test_the_stated_doubt_is_that_of_many_cells():
    found = []
    for seed in range(40):
        cell = make_cell(np.random.default_rng(seed), 12, MID)
        check = check_scale(cell.views, cell.X[:3, :3], BOARD)
        assert check is not None
        found.append((check.scale - 1) / check.sigma)
    assert 0.7 < np.std(found) < 1.4
    assert abs(np.mean(found)) < 0.6


def test_a_few_views_or_one_place_tell_no_size():
    cell = make_cell(np.random.default_rng(3), 10, MID)
    rotation = cell.X[:3, :3]
    assert check_scale(cell.views.select([0, 1, 2]), rotation, BOARD) is None
    assert check_scale(cell.views.select([0, 1, 2, 3]), rotation, BOARD) is not None
    assert check_scale(cell.views.select([0] * 6), rotation, BOARD) is None
