"""How corners move with board pose, lens and board shape: against differences, for every lens model."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrate.handeye.reprojection import bent_points, corner_residuals, linearise_corners
from calibrate.views.projection import intrinsics_vector, with_intrinsics_vector
from calibrate.views.view_set import observe_views
from recordings.geometry import perturb
from tests.calibrate.cells import LENSES, changed, printed, real_cell

SHAPE = (0.01, 0.02, 0.003, -0.002, 0.001)


def observed_cell(seed, camera):
    """Three pictures, one with corners missing, of a board that is far from its drawing."""
    cell = real_cell(np.random.default_rng(seed), 3, camera=camera, shape=SHAPE)
    views = changed(cell.views, [1], corners=lambda v: v.corners.part(slice(30)))
    return observe_views(views), views.camera_from_board


@pytest.mark.parametrize("model", LENSES)
@settings(max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_normal_equations_are_those_of_differences(model, seed):
    camera = LENSES[model]
    observed, C = observed_cell(seed, camera)
    rng = np.random.default_rng(seed)
    shape = rng.normal(size=5) * [0.01, 0.01, 1e-3, 1e-3, 1e-3]
    weights = rng.uniform(0.2, 1.0, observed.present.shape)
    vector = intrinsics_vector(camera)
    lens = len(vector)
    size = 6 + lens + 5
    # Steps that move a corner by about as much: distortion in its own units, the board in metres.
    h = np.concatenate([np.full(6, 1e-6), np.full(4, 1e-3), np.full(lens - 4, 3e-4), np.full(5, 1e-6)])

    def pixels(step):
        moved = with_intrinsics_vector(camera, vector + step[6 : 6 + lens])
        at = perturb(C, np.broadcast_to(step[:6], (3, 6)))
        residual = corner_residuals(observed, moved, at, shape + step[6 + lens :])
        return (residual * np.sqrt(weights)[..., None]).reshape(3, -1)

    J = np.stack([(pixels(-d) - pixels(d)) / (2 * d.sum()) for d in np.diag(h)], axis=-1)
    r = pixels(np.zeros(size))
    N, right = np.swapaxes(J, 1, 2) @ J, np.einsum("nra,nr->na", J, r)
    blocks = linearise_corners(observed, camera, C, weights, True, shape)
    found = np.block([[blocks.LL, blocks.LG], [np.swapaxes(blocks.LG, 1, 2), blocks.GG]])
    scale = np.sqrt(np.einsum("naa->na", N))
    np.testing.assert_allclose(
        found / scale[:, :, None] / scale[:, None], N / scale[:, :, None] / scale[:, None], atol=1e-5
    )
    found_right = np.concatenate([blocks.Lr, blocks.Gr], axis=1)
    np.testing.assert_allclose(found_right / scale, right / scale, atol=1e-6 * np.abs(r).max() * 100)
    np.testing.assert_allclose(blocks.rr, (r * r).sum(axis=1))
    assert blocks.rows == pytest.approx(2 * (weights * observed.present).sum(axis=1))


def test_a_board_is_bent_as_its_numbers_say():
    cell = real_cell(np.random.default_rng(0), 3)
    observed = observe_views(cell.views)
    found = bent_points(observed, np.array(SHAPE))
    np.testing.assert_allclose(found[0], printed(cell.views.views[0].corners.points, SHAPE), atol=1e-12)


def test_many_views_are_linearised_in_parts_to_the_same_bits(monkeypatch):
    camera = LENSES["plumb_bob"]
    observed, C = observed_cell(0, camera)
    whole = linearise_corners(observed, camera, C, observed.present, True, np.zeros(5))
    monkeypatch.setattr("calibrate.handeye.reprojection._CHUNK_POINTS", 1)
    parts = linearise_corners(observed, camera, C, observed.present, True, np.zeros(5))
    assert all(np.array_equal(value, getattr(parts, name)) for name, value in vars(whole).items())
