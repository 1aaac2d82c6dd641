"""How the implied flange moves with X, the board's pose and each picture: against differences."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrate.geometry import difference, perturb, pose, random_rotation
from calibrate.handeye.cell_state import flange_derivatives
from calibrate.views import implied_flange
from tests.calibrate.cells import MOUNTS


def anywhere(rng, count=None):
    if count is None:
        return pose(random_rotation(rng), rng.normal(size=3))
    return np.array([anywhere(rng) for _ in range(count)])


@MOUNTS
@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), far=st.sampled_from([1e-9, 0.01, 0.5]))
def test_derivatives_are_those_of_differences_near_and_far(mount, seed, far):
    rng = np.random.default_rng(seed)
    X, Y, C = anywhere(rng), anywhere(rng), anywhere(rng, 4)
    recorded = perturb(implied_flange(mount, X, Y, C), far * rng.normal(size=(4, 6)))

    def miss(dX, dY, dC):
        implied = implied_flange(mount, perturb(X, dX), perturb(Y, dY), perturb(C, np.tile(dC, (4, 1))))
        return difference(implied, recorded)

    exact = flange_derivatives(mount, X, Y, C, miss(*np.zeros((3, 6))))
    h = 1e-6
    for which in range(3):
        for k in range(6):
            step = np.zeros((3, 6))
            step[which, k] = h
            numeric = (miss(*step) - miss(*-step)) / (2 * h)
            np.testing.assert_allclose(
                exact[which][:, :, k], numeric, atol=2e-7 * (1 + np.abs(numeric).max())
            )
