import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.scene import random_rotation
from calibrate.handeye.axxb.certificate import TOLERANCE, _constraints, certify
from calibrate.handeye.axxb.global_start import solve_global
from calibrate.handeye.axxb.objective import build_objective
from calibrate.handeye.axxb.pairs import all_pairs
from recordings.geometry import perturb, pose, rotation_exp
from tests.calibrate.cells import noisy_pairs


def test_the_twenty_constraints_hold_on_rotations_and_only_there():
    C = _constraints()
    assert C.shape == (20, 10, 10)
    z = np.append(random_rotation(np.random.default_rng(0)).ravel(), 1.0)
    np.testing.assert_allclose(np.einsum("kij,i,j->k", C, z, z), 0, atol=1e-12)
    mirrored = np.append(np.diag([1.0, 1.0, -1.0]).ravel(), 1.0)
    assert np.abs(np.einsum("kij,i,j->k", C, mirrored, mirrored)).max() > 0.1


@given(seed=st.integers(0, 10_000), views=st.integers(3, 12), sigma=st.sampled_from([0.0, 1e-4, 1e-2, 0.1]))
@settings(max_examples=25)
def test_any_mount_at_any_noise_is_solved_and_proven(seed, views, sigma):
    pairs, X = noisy_pairs(seed, views, sigma)
    result = solve_global(pairs)
    assert result.certificate.certified
    assert (
        result.certificate.lower_bound
        <= result.certificate.objective + 1e-9 * abs(result.objective.gram).max()
    )
    if sigma == 0.0:
        np.testing.assert_allclose(result.X, X, atol=1e-9)


@pytest.mark.parametrize("sigma", [0.0, 1e-3])
def test_a_corrupted_X_is_not_certified(sigma):
    pairs, _ = noisy_pairs(1, 10, sigma)
    X = solve_global(pairs).X
    for axis in np.eye(3):
        turned = perturb(X, [0, 0, 0, *(1e-4 * axis)])
        certificate = certify(build_objective(pairs, centre=turned)).certificate
        assert not certificate.certified
        assert certificate.relative_gap > 10 * TOLERANCE


def test_a_local_minimum_far_away_is_not_certified():
    pairs, _ = noisy_pairs(2, 10, 1e-3)
    X = solve_global(pairs).X
    flipped = X.copy()
    flipped[:3, :3] = X[:3, :3] @ rotation_exp([np.pi, 0, 0])
    assert not certify(build_objective(pairs, centre=flipped)).certificate.certified


def test_one_axis_is_certified_though_other_optima_are_as_good():
    rng = np.random.default_rng(3)
    X = pose(random_rotation(rng), rng.normal(size=3))
    R = rotation_exp(np.linspace(0, 2, 8)[:, None] * np.array([0.0, 0.0, 1.0]))
    H = pose(R, rng.normal(size=(8, 3)) * [1, 1, 0])
    C = np.linalg.inv(X) @ np.linalg.inv(H) @ pose(random_rotation(rng), rng.normal(size=3))
    assert solve_global(all_pairs(H, C)).certificate.certified
