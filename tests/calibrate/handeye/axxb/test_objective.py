"""The collapsed form against plain loops over pairs, which the paper's equations are copied into."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.scene import random_rotation
from calibrate.handeye.axxb.objective import build_objective
from calibrate.handeye.axxb.pairs import Pairs, all_pairs
from recordings.geometry import perturb, pose
from tests.calibrate.cells import exact_motions, noisy_pairs


def by_loop(pairs: Pairs, X: np.ndarray, form: str, weight: float) -> float:
    """Equations 13, 14 and 16, pair by pair."""
    total = 0.0
    for A, B in zip(pairs.A, pairs.B, strict=True):
        R_A, R_B, R = A[:3, :3], B[:3, :3], X[:3, :3]
        if form == "log":
            alpha = Rotation.from_matrix(R_A).as_rotvec()
            beta = Rotation.from_matrix(R_B).as_rotvec()
            total += ((alpha - R @ beta) ** 2).sum()
        else:
            total += ((R_A @ R - R @ R_B) ** 2).sum() / 2
        total += weight * ((R_A @ X[:3, 3] + A[:3, 3] - R @ B[:3, 3] - X[:3, 3]) ** 2).sum()
    return total


@pytest.mark.parametrize("form", ["log", "chordal"])
@given(seed=st.integers(0, 10_000), views=st.integers(3, 8), weight=st.sampled_from([0.1, 1.0, 10.0]))
@settings(max_examples=15)
def test_the_form_equals_the_sum_over_pairs_anywhere(form, seed, views, weight):
    pairs, X = noisy_pairs(seed, views)
    objective = build_objective(pairs, form, weight)
    rng = np.random.default_rng(seed)
    for candidate in (X, pose(random_rotation(rng), rng.normal(size=3))):
        assert objective.value(candidate) == pytest.approx(by_loop(pairs, candidate, form, weight), rel=1e-9)


@pytest.mark.parametrize("form", ["log", "chordal"])
def test_nothing_cancels_near_the_optimum_of_clean_data(form):
    """A plain moment matrix is wrong by 1e-16 of its trace; the recentred form keeps the digits."""
    rng = np.random.default_rng(5)
    X = pose(random_rotation(rng), rng.normal(size=3))
    pairs = all_pairs(*exact_motions(rng, 20, X))
    objective = build_objective(pairs, form)
    near = perturb(X, 1e-9 * np.ones(6))
    assert objective.value(near) == pytest.approx(by_loop(pairs, near, form, 1.0), rel=1e-4)
