"""The information that planning uses is that of the solver's own estimate."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.board import board_points
from calibrate.geometry import inverse, perturb, pose, random_rotation, rotation_exp, transform_points
from calibrate.information import Noise, covariance_of, view_information
from calibrate.likelihood.model import Observations, State
from calibrate.likelihood.residuals import linearise
from calibrate.projection import project
from recordings.messages import BoardKind, BoardSpec, CameraModel

BOARD = board_points(BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025))
LENS = CameraModel(
    1280, 1024, ((1667.0, 0, 640), (0, 1660.0, 512), (0, 0, 1)), (-0.1, 0.12, 1e-3, -5e-4, 0.02)
)
NOISE = Noise(0.2, 3e-4, 5e-4)


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


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("free", [True, False])
def test_covariance_equals_the_estimates(mount, free):
    X, Y, C, E = scene(mount)
    n, k = len(C), len(BOARD)
    pixels = project(LENS, transform_points(C, BOARD)).pixels
    points = np.broadcast_to(BOARD, (n, k, 3))
    observed = Observations(mount, E, points, pixels, np.ones((n, k)))
    normal = linearise(observed, State(X, Y, C, LENS, np.zeros(0)), np.ones((n, k)), free)
    sigma = np.array([NOISE.pixel_px, NOISE.robot_m, NOISE.robot_rad, 1.0])
    theirs = normal.solve(sigma**-2).covariance[:12, :12]
    information = view_information(mount, LENS, E, X, Y, BOARD, NOISE, free).sum(axis=0)
    ours = covariance_of(information)[:12, :12]
    np.testing.assert_allclose(np.sqrt(np.diag(ours)), np.sqrt(np.diag(theirs)), rtol=1e-5)
    scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
    np.testing.assert_allclose(ours / scale, theirs / scale, atol=1e-5)


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_information_is_that_of_finite_differences(mount):
    """With an exact robot the information is JᵀJ/σ², J by differences of the projected pixels."""
    X, Y, _, E = scene(mount, n=1)

    def pixels(x, y):
        C = inverse(E @ x) @ y if mount == "eye-in-hand" else inverse(x) @ E @ y
        return project(LENS, transform_points(C, BOARD)).pixels.ravel()

    step = 1e-6
    eye = np.eye(6) * step
    by_x = [(pixels(perturb(X, d), Y) - pixels(perturb(X, -d), Y)) / (2 * step) for d in eye]
    by_y = [(pixels(X, perturb(Y, d)) - pixels(X, perturb(Y, -d))) / (2 * step) for d in eye]
    J = np.stack(by_x + by_y, axis=1)
    found = view_information(mount, LENS, E, X, Y, BOARD, Noise(0.5, 0.0, 0.0), False)[0]
    np.testing.assert_allclose(found, J.T @ J / 0.25, rtol=1e-5, atol=1e-3)


def test_more_views_never_hurt_and_robot_noise_always_does():
    X, Y, _, E = scene("eye-in-hand", n=20)
    each = view_information("eye-in-hand", LENS, E, X, Y, BOARD, NOISE, True).cumsum(axis=0)
    spread = np.trace(covariance_of(each[4:])[:, :6, :6], axis1=1, axis2=2)
    assert (np.diff(spread) < 0).all()
    worse = view_information("eye-in-hand", LENS, E, X, Y, BOARD, Noise(0.2, 1e-3, 2e-3), True).sum(axis=0)
    assert (np.diag(covariance_of(worse)) > np.diag(covariance_of(each[-1]))).all()


def test_a_direction_without_information_has_a_huge_variance():
    """Turns about one axis only: the camera's place along it is free."""
    X, Y, C, _ = scene("eye-in-hand")
    flat = C.copy()
    flat[:, :3, :3] = rotation_exp(np.outer(np.linspace(-0.5, 0.5, len(C)), [0, 0, 1.0]))
    E = Y @ inverse(X @ flat)
    information = view_information("eye-in-hand", LENS, E, X, Y, BOARD, NOISE, False).sum(axis=0)
    assert np.sqrt(np.linalg.eigvalsh(covariance_of(information)[:3, :3]).max()) > 0.05
