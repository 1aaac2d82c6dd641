import re

import numpy as np
import pytest

from benchmarks.scene import random_rotation
from calibrate.errors import DegenerateMotionError
from calibrate.handeye.axxb.global_start import solve_global
from calibrate.handeye.axxb.objective import pair_covariance
from calibrate.handeye.axxb.pairs import Pairs, all_pairs
from calibrate.handeye.metrics import axis_spread, board_spread, distance_in_sigmas, observe, require_motion
from recordings.geometry import perturb, pose, rotation_exp
from tests.calibrate.cells import LOW, exact_motions, make_cell


def turns(first_deg, second_deg, misfit_deg=0.0):
    """Pairs that turn about x and about y by these angles (rms over all); B turns by `misfit_deg` more."""
    signs = np.tile([1.0, -1.0], 10)
    axes = np.repeat(np.eye(3)[:2], 10, axis=0)
    angles = np.radians(np.repeat([first_deg, second_deg], 10) * np.sqrt(2))
    A, B = (
        pose(rotation_exp((signs * (angles + more))[:, None] * axes), np.zeros(3))
        for more in (0.0, np.radians(misfit_deg))
    )
    return Pairs(A, B, np.arange(20), np.arange(1, 21))


def test_the_axes_are_those_that_were_turned_about():
    spread, directions = axis_spread(turns(20, 5).alpha)
    assert np.degrees(spread) == pytest.approx([20, 5, 0])
    np.testing.assert_allclose(np.abs(directions), np.eye(3), atol=1e-9)
    seen = observe(turns(20, 5), np.eye(6), 0.5, "flange")
    assert seen.axis_spread == pytest.approx(0.25)
    assert np.degrees(seen.largest_angle_rad) == pytest.approx(20 * np.sqrt(2))


@pytest.mark.parametrize("misfit_deg", [0.0, 5.0])
def test_turns_that_no_robot_means_are_none(misfit_deg):
    """Whatever the noise: how much a small turn tells is the estimate's own matter."""
    require_motion(turns(20, 0.31, misfit_deg))
    with pytest.raises(DegenerateMotionError) as refused:
        require_motion(turns(20, 0.29, misfit_deg))
    assert refused.value.code == "one-axis"
    assert np.degrees(refused.value.values["second_axis_rad"]) == pytest.approx(0.29, rel=1e-6)
    with pytest.raises(DegenerateMotionError):
        require_motion(turns(0.29, 0.03, misfit_deg))


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


@pytest.mark.parametrize("direction", range(6))
def test_each_direction_is_weighed_as_metres_where_the_board_is(direction):
    pairs = all_pairs(*exact_motions(np.random.default_rng(2), 6, np.eye(4)))
    variance = np.full(6, 1e-10)
    variance[direction] = 4e-6
    seen = observe(pairs, np.diag(variance), 0.5, "flange")
    told = [float(number) for number in re.findall(r"[+-]?\d+\.\d+", seen.weakest_text)]
    assert told == [*np.eye(3)[direction % 3], *([2.0] if direction < 3 else [1.0, 0.5])]


def test_pair_covariance_is_the_scatter_of_the_pair_solution():
    """Pairs share views: counting them as independent would claim a third of the true error."""
    squares = []
    for seed in range(24):
        cell = make_cell(np.random.default_rng(seed), 25, LOW)
        pairs = all_pairs(cell.views.base_from_flange, cell.views.camera_from_board)
        result = solve_global(pairs)
        covariance = pair_covariance(result.objective, pairs, result.X)
        squares.append(distance_in_sigmas(result.X, cell.X, covariance) ** 2)
    assert 4 < np.median(squares) < 9  # χ²(6) has its median at 5.35
