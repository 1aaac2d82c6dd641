"""What is still used of a view that is bad, or may be."""

import numpy as np
import pytest
from scipy.special import softmax

from calibrate.bad_kinds import SIZES, bad_kinds
from calibrate.mixture import LinearMisses, find_good_views
from calibrate.worth import number_worths, widen

SIGMA = np.array([3e-4, 5e-4])
ROBOT = np.repeat(SIGMA, 3)


def corner_noise(rng, n):
    root = rng.normal(size=(n, 6, 6)) * 2e-4
    return root @ np.swapaxes(root, 1, 2)


def misses_of(rng, n=20, error=0.0) -> LinearMisses:
    """Good views, the first one off by `error` (6,) robot sigmas; truth: all parameters 0."""
    by_corners = corner_noise(rng, n)
    root = np.linalg.cholesky(by_corners + np.diag(ROBOT**2))
    miss = (root @ rng.normal(size=(n, 6, 1)))[..., 0]
    miss[0] += error * ROBOT
    nothing = np.zeros(12)
    return LinearMisses(miss, rng.normal(size=(n, 6, 12)), by_corners, nothing, nothing, SIGMA)


def worths(misses, good=None):
    n = len(misses.miss)
    return number_worths(misses, np.arange(1, n) if good is None else good, np.ones(n, dtype=bool))


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_used_of_a_view_that_is_wrong_in_everything(seed):
    rng = np.random.default_rng(seed)
    found = worths(misses_of(rng, error=1000 * rng.choice([-1, 1], 6)))
    assert (found.worth[0] == 0).all()
    assert (found.worth[1:] > 1 - 1e-6).mean() > 0.8


@pytest.mark.parametrize("seed", [14, 33])
def test_where_all_good_is_hardly_likelier_than_some_bad_the_bad_ones_are_left_out(seed):
    """What is left out by mistake still counts by its worth, so keeping is the worse mistake."""
    rng = np.random.default_rng(seed)
    misses = misses_of(rng, 25)
    for bad in range(3):
        number = rng.integers(6)
        misses.miss[bad, number] += 7 * ROBOT[number]
    everyone = np.arange(25)
    np.testing.assert_array_equal(find_good_views(misses, everyone, everyone >= 0), everyone[3:])


@pytest.mark.parametrize("number", range(6))
def test_of_a_view_with_one_wrong_number_the_other_five_are_used(number):
    found = worths(misses_of(np.random.default_rng(number), error=60 * np.eye(6)[number]))
    assert found.worth[0, number] < 0.1
    assert (np.delete(found.worth[0], number) > 0.9).all()


def test_the_farther_off_the_less_it_counts_and_in_between_nobody_is_sure():
    sizes = (0, 2.5, 4, 8)
    found = [worths(misses_of(np.random.default_rng(5), error=size * np.ones(6))) for size in sizes]
    each = [float(worth.worth[0].mean()) for worth in found]
    assert each == sorted(each, reverse=True)
    assert each[0] > 0.9 > each[1] > 0.3 > each[3]
    lost = [float(np.trace(worth.lost)) for worth in found]
    assert lost[1] > max(lost[0], lost[3])


def test_a_view_whose_corners_fit_no_board_counts_nothing():
    misses = misses_of(np.random.default_rng(0))
    usable = np.arange(20) != 4
    found = number_worths(misses, np.flatnonzero(usable), usable)
    assert (found.worth[4] == 0).all()


def test_expected_precision_and_scores_are_those_of_each_kinds_covariance():
    rng = np.random.default_rng(1)
    n, left = 7, rng.normal(size=(7, 6)) * 1e-3
    covariance = corner_noise(rng, n) + np.diag(ROBOT**2)
    found = bad_kinds(left, covariance, SIGMA)
    rows = [range(6), range(3), range(3, 6), *([k] for k in range(6))]
    masks = [np.isin(np.arange(6), list(row)) for row in rows]
    each = np.array(
        [
            [np.linalg.inv(S + np.diag((size * ROBOT) ** 2 * mask)) for size in SIZES for mask in masks]
            for S in covariance
        ]
    )
    np.testing.assert_allclose(found.scores(left), (each @ left[:, None, :, None])[..., 0], rtol=1e-6)
    chances = softmax(rng.normal(size=(n, 1 + each.shape[1])), axis=1)
    expected = chances[:, 0, None, None] * np.linalg.inv(covariance) + np.einsum(
        "nk,nkij->nij", chances[:, 1:], each
    )
    np.testing.assert_allclose(found.expected_precision(chances[:, 1:]), expected, rtol=1e-6, atol=1e-3)
    assert np.linalg.eigvalsh(expected)[:, 0].min() > 0


def test_lost_information_widens_the_covariance_but_not_beyond_twice_its_sigmas():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(12, 12))
    information = root @ root.T
    covariance = np.linalg.inv(information)
    np.testing.assert_allclose(widen(covariance, np.zeros((12, 12))), covariance, rtol=1e-6)
    np.testing.assert_allclose(widen(covariance, 0.5 * information), 2 * covariance, rtol=1e-6)
    np.testing.assert_allclose(widen(covariance, 3 * information), 4 * covariance, rtol=1e-6)
