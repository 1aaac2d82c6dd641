"""A camera or a board that was moved half-way is named, and boards that were read turned are set right."""

from dataclasses import replace

import numpy as np
import pytest

from calibrate.handeye.solution import Reading
from calibrate.handeye.solve import solve_views
from calibrate.pipeline.gates import judge
from recordings.geometry import pose, rotation_exp, transform_points
from tests.calibrate.cells import MID, MOUNTS, QUICK, changed, inside, make_cell, slipped

SLIP = np.array([0.02, -0.015, 0.01, 0.02, 0.03, -0.02])


def moved_cell(seed, mount, what, at, views=24, size=1.0):
    """Views, X and the board's pose after the slip before view `at`."""
    rng = np.random.default_rng([8, seed])
    return slipped(make_cell(rng, views, MID, mount=mount), what, at, size * SLIP, MID, rng)


@pytest.mark.parametrize(
    ("mount", "what", "size"),
    [
        ("eye-in-hand", "camera", 1.0),
        ("eye-to-hand", "board", 1.0),
        ("eye-in-hand", "board", 0.3),
        ("eye-in-hand", "board", 5.0),
    ],
)
def test_a_move_half_way_is_named_with_its_place_and_does_not_pass(mount, what, size):
    views, _, _ = moved_cell(0, mount, what, 12, size=size)
    numbered = replace(views, views=tuple(replace(view, index=2 * view.index + 5) for view in views))
    solution = solve_views(numbered, QUICK)
    session = solution.judgement.session
    assert session.reading is (Reading.CAMERA_MOVED if what == "camera" else Reading.BOARD_MOVED)
    assert abs(session.at - 12) <= 1
    assert session.numbers == tuple(2 * place + 5 for place in (session.at, *session.between))
    assert "session" in [g.name for g in judge(solution) if not g.passed]


@pytest.mark.parametrize("at", [20, 22])
def test_a_camera_that_moved_near_the_end_never_passes(at):
    """X of before the move is of no use to anybody now."""
    views, X, _ = moved_cell(1, "eye-in-hand", "camera", at)
    solution = solve_views(views, QUICK)
    assert inside(solution, X) or [g.name for g in judge(solution) if not g.passed]


def half_turn(view):
    return pose(rotation_exp([0, 0, np.pi]), [*view.corners.points[:, :2].max(axis=0), 0.0])


@MOUNTS
def test_half_turned_boards_are_set_right_and_used(mount):
    cell = make_cell(np.random.default_rng(0), 20, MID, mount=mount)
    views = changed(
        cell.views,
        [2, 9, 15],
        points=lambda v: transform_points(half_turn(v), v.corners.points),
        camera_from_board=lambda v: v.camera_from_board @ half_turn(v),
    )
    solution, straight = solve_views(views, QUICK), solve_views(cell.views, QUICK)
    assert (solution.evidence.views.turned, straight.evidence.views.turned) == ([2, 9, 15], [])
    assert solution.evidence.views.rejected == [] and min(solution.evidence.weights.values()) > 0.3
    np.testing.assert_allclose(solution.matrix, straight.matrix, atol=1e-6)
    np.testing.assert_allclose(solution.covariance, straight.covariance, rtol=1e-3, atol=1e-15)
