"""The information that planning uses is that of the solver's own estimate."""

from __future__ import annotations

import numpy as np

from benchmarks.scene import random_rotation
from calibrate.boards.model import board_points
from calibrate.geometry import inverse, perturb, pose, rotation_exp, transform_points
from calibrate.handeye.information import (
    covariance_of,
    predicted_error_m,
    prior_information,
    view_information,
)
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.solve import SolveOptions, solve_views
from calibrate.projection import intrinsics_vector, project, with_intrinsics_vector
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel
from tests.calibrate.cells import MID, MOUNTS, make_cell

BOARD = board_points(BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025))
LENS = CameraModel(
    1280, 1024, ((1667.0, 0, 640), (0, 1660.0, 512), (0, 0, 1)), (-0.1, 0.12, 1e-3, -5e-4, 0.02)
)
PRIOR = prior_information(LENS, True, BoardTolerance())
NOISE = MeasurementNoise(0.2, 3e-4, 5e-4)


def scene(mount, n=12, seed=3):
    rng = np.random.default_rng(seed)
    X, Y = (
        pose(random_rotation(rng), rng.normal(0, 0.1, 3)),
        pose(random_rotation(rng), rng.normal(0, 0.5, 3)),
    )
    middle = BOARD.mean(axis=0)
    R = rotation_exp(rng.normal(0, 0.35, (n, 3)))
    C = pose(R, np.array([0, 0, 0.5]) + rng.normal(0, 0.02, (n, 3)) - R @ middle)
    E = Y @ inverse(X @ C) if mount == "eye-in-hand" else X @ C @ inverse(Y)
    return X, Y, C, E


@MOUNTS
def test_the_predicted_sigma_is_the_one_that_the_solver_states(mount):
    """25 views of a simulated cell: their geometry alone says what the estimate will claim."""
    cell = make_cell(np.random.default_rng(4), 25, MID, mount=mount)
    solution = solve_views(cell.views, SolveOptions(holdout=False, folds=False))
    noise = MID
    points = cell.views.views[0].board_points
    each = view_information(mount, cell.camera, cell.flange, cell.X, cell.Y, points, noise)
    prior = prior_information(cell.camera, True, BoardTolerance())
    predicted = covariance_of(each.sum(axis=0), prior)[:6, :6]
    ratio = np.sqrt(np.diag(solution.covariance) / np.diag(predicted))
    assert (ratio > 0.7).all() and (ratio < 1.4).all()
    shown_m = predicted_error_m(each.sum(axis=0), prior, cell.X, solution.working_distance_m)
    assert 0.7 < shown_m / solution.predicted_error_m < 1.4


@MOUNTS
def test_information_is_that_of_finite_differences(mount):
    """With an exact robot it is JᵀJ/σ², J by differences of the pixels; X, board, lens and shape alike."""
    X, Y, _, E = scene(mount, n=1)
    (low, high), half = (BOARD.min(axis=0), BOARD.max(axis=0)), np.ptp(BOARD, axis=0)[:2] / 2
    u, v = ((BOARD[:, :2] - (low + high)[:2] / 2) / half).T

    def pixels(step):
        x, y = perturb(X, step[:6]), perturb(Y, step[6:12])
        s, a, b1, b2, b3 = step[21:]
        bent = b1 * (1 - u**2) + b2 * (1 - v**2) + b3 * u * v
        points = np.stack([BOARD[:, 0] * (1 + s + a / 2), BOARD[:, 1] * (1 + s - a / 2), bent], axis=-1)
        C = inverse(E @ x) @ y if mount == "eye-in-hand" else inverse(x) @ E @ y
        lens = with_intrinsics_vector(LENS, intrinsics_vector(LENS) + step[12:21])
        return project(lens, transform_points(C, points)).pixels.ravel()

    h = 1e-6
    J = np.stack([(pixels(d) - pixels(-d)) / (2 * h) for d in h * np.eye(26)], axis=1)
    found = view_information(mount, LENS, E, X, Y, BOARD, MeasurementNoise(0.5, 0.0, 0.0))[0]
    scale = np.linalg.norm(J, axis=0) / 0.5
    np.testing.assert_allclose(
        found / np.outer(scale, scale), J.T @ J / 0.25 / np.outer(scale, scale), atol=1e-5
    )
