import numpy as np
import pytest

from benchmarks.scene import random_rotation
from calibrate.handeye.axxb.pairs import (
    MAX_PAIRS,
    all_pairs,
    consecutive_pairs,
    mount_poses,
    screw_invariants,
)
from recordings.geometry import inverse, pose
from tests.calibrate.cells import MOUNTS, exact_motions, make_cell


@MOUNTS
def test_pairs_follow_the_published_equations_for_each_mount(mount):
    cell = make_cell(np.random.default_rng(0), 6, mount=mount)
    F, C = cell.views.base_from_flange, cell.views.camera_from_board
    pairs = consecutive_pairs(mount_poses(F, mount), C)
    for n in range(5):
        if mount == "eye-in-hand":  # the paper, eq. 21
            A = np.linalg.inv(F[n + 1]) @ F[n]
        else:  # the blog's eye-to-hand derivation
            A = F[n + 1] @ np.linalg.inv(F[n])
        np.testing.assert_allclose(pairs.A[n], A, atol=1e-12)
        np.testing.assert_allclose(pairs.B[n], C[n + 1] @ np.linalg.inv(C[n]), atol=1e-12)


def test_screw_invariants_do_not_depend_on_the_camera():
    rng = np.random.default_rng(3)
    X = pose(random_rotation(rng), rng.normal(size=3))
    pairs = all_pairs(*exact_motions(rng, 10, X))
    for of_A, of_B in zip(screw_invariants(pairs.A), screw_invariants(pairs.B), strict=True):
        np.testing.assert_allclose(of_A, of_B, atol=1e-6)
    angle, along = screw_invariants(pairs.A)
    again_angle, again_along = screw_invariants(X @ pairs.A @ inverse(X))
    np.testing.assert_allclose(angle, again_angle, atol=1e-6)
    np.testing.assert_allclose(along, again_along, atol=1e-6)


@pytest.mark.parametrize("n", [3000, MAX_PAIRS // 2 + 1])
def test_above_the_limit_pairs_are_few_and_still_reach_across_the_session(n):
    H = np.broadcast_to(np.eye(4), (n, 4, 4))
    pairs = all_pairs(H, H)
    assert set(pairs.first) | set(pairs.second) == set(range(n)) and (pairs.first < pairs.second).all()
    apart = pairs.second - pairs.first
    assert len(pairs) <= max(MAX_PAIRS, 3 * n) and ((apart > n // 5) & (apart < 4 * n // 5)).sum() >= n
