import numpy as np
import pytest

from calibrate.assess import board_spread, distance_in_sigmas, motion_errors, observe, point_error_m
from calibrate.geometry import perturb, pose, random_rotation, rotation_angle
from calibrate.pair_covariance import pair_covariance
from calibrate.pairs import all_pairs
from calibrate.robust import solve_global
from tests.calibrate.cells import LOW, exact_motions, make_cell


def test_motion_errors_vanish_at_the_truth_and_measure_a_turn():
    rng = np.random.default_rng(0)
    X = pose(random_rotation(rng), [0.1, 0.2, 0.3])
    pairs = all_pairs(*exact_motions(rng, 6, X))
    e_t, e_R = motion_errors(X, pairs)
    assert e_t.max() < 1e-12
    assert e_R.max() < 1e-12
    wrong = perturb(X, [0, 0, 0, 0.01, 0, 0])
    _, e_R = motion_errors(wrong, pairs)
    estimated = wrong @ pairs.B @ np.linalg.inv(wrong)
    angle = rotation_angle(np.swapaxes(pairs.A[:, :3, :3], 1, 2) @ estimated[:, :3, :3])
    np.testing.assert_allclose(e_R, 2 * np.sin(angle / 2), atol=1e-12)  # the spectral norm of R1 - R2


def test_board_spread_of_a_known_scatter():
    rng = np.random.default_rng(1)
    X = pose(random_rotation(rng), [0.1, 0, 0])
    H, C = exact_motions(rng, 4000, X)
    scattered = perturb(np.eye(4), rng.normal(size=(4000, 6)) * np.repeat([1e-3, 2e-3], 3)) @ H
    spread_m, spread_rad = board_spread(scattered, C, X)
    Y = (H @ X @ C)[0]
    expected = np.sqrt(3e-6 + 2 * 4e-6 * (Y[:3, 3] @ Y[:3, 3]))  # the turn swings the board's lever too
    assert spread_m == pytest.approx(expected, rel=0.05)
    assert spread_rad == pytest.approx(2e-3 * np.sqrt(3), rel=0.05)


def test_the_weakest_direction_is_the_covariances_own():
    rng = np.random.default_rng(2)
    pairs = all_pairs(*exact_motions(rng, 6, pose(random_rotation(rng), [0, 0, 0.1])))
    covariance = np.diag([1e-8, 1e-8, 4e-6, 1e-10, 1e-10, 1e-10])
    seen = observe(pairs, covariance, 0.5, "flange")
    np.testing.assert_allclose(np.abs(seen.weakest_direction), np.eye(6)[2], atol=1e-9)
    assert seen.weakest_sigma_m == pytest.approx(2e-3)
    assert "shift along (+0.00, +0.00, +1.00) in flange" in seen.weakest_text
    turned = observe(pairs, np.diag([1e-8, 1e-8, 1e-8, 1e-10, 1e-4, 1e-10]), 0.5, "flange")
    assert "turn about" in turned.weakest_text
    assert turned.weakest_sigma_m == pytest.approx(5e-3)


def test_point_error_grows_with_distance_by_the_rotation_alone():
    X = pose(random_rotation(np.random.default_rng(3)), [0, 0, 0])
    covariance = np.diag([0, 0, 0, 1e-6, 1e-6, 1e-6])
    assert point_error_m(X, covariance, 0.0) == 0.0
    assert point_error_m(X, covariance, 2.0) == pytest.approx(2.0 * np.sqrt(2e-6))


def test_distance_in_sigmas():
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3)
    X = pose(random_rotation(np.random.default_rng(4)), [1, 2, 3])
    assert distance_in_sigmas(perturb(X, [3e-3, 0, 0, 0, 0.04, 0]), X, covariance) == pytest.approx(5.0)


def test_pair_covariance_is_the_scatter_of_the_pair_solution():
    """Pairs share views: counting them as independent would claim a third of the true error."""
    squares = []
    for seed in range(40):
        cell = make_cell(np.random.default_rng(seed), 25, LOW)
        pairs = all_pairs(cell.views.base_from_flange, cell.views.camera_from_board)
        result = solve_global(pairs, 0)
        covariance = pair_covariance(result.objective, pairs, result.X)
        squares.append(distance_in_sigmas(result.X, cell.X, covariance) ** 2)
    assert 4 < np.median(squares) < 9  # χ²(6) has its median at 5.35
