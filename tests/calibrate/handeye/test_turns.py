"""Boards that were read upside down are set right, and every view is kept."""

import numpy as np
import pytest

from calibrate.geometry import pose, rotation_exp, transform_points
from calibrate.handeye.solve import SolveOptions, solve_views
from tests.calibrate.cells import MID, changed, make_cell

QUICK = SolveOptions(holdout=False, folds=False)


def half_turn(view):
    return pose(rotation_exp([0, 0, np.pi]), [*view.board_points[:, :2].max(axis=0), 0.0])


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_half_turned_boards_are_set_right_and_used(mount):
    cell = make_cell(np.random.default_rng(0), 20, MID, mount=mount)
    views = changed(
        cell.views,
        [2, 9, 15],
        board_points=lambda v: transform_points(half_turn(v), v.board_points),
        camera_from_board=lambda v: v.camera_from_board @ half_turn(v),
    )
    solution, straight = solve_views(views, QUICK), solve_views(cell.views, QUICK)
    assert (solution.turned, straight.turned) == ((2, 9, 15), ())
    assert solution.rejected == () and min(solution.weights.values()) > 0.3
    np.testing.assert_allclose(solution.matrix, straight.matrix, atol=1e-6)
    np.testing.assert_allclose(solution.covariance, straight.covariance, rtol=1e-3, atol=1e-15)
