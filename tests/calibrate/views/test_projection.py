"""Projection: skew, and the space behind the camera; derivatives: see test_reprojection."""

import msgspec
import numpy as np
import pytest

from calibrate.views.projection import project
from tests.calibrate.cells import LENSES

POINTS = np.random.default_rng(0).normal(size=(30, 3)) * [0.2, 0.2, 0.1] + [0, 0, 1.0]


@pytest.mark.parametrize("model", LENSES)
def test_a_camera_matrix_with_skew_maps_what_the_lens_has_bent(model):
    K = np.array([[800.0, 30.0, 320.0], [0.0, 790.0, 240.0], [0.0, 0.0, 1.0]])
    bent = project(msgspec.structs.replace(LENSES[model], matrix=np.eye(3).tolist()), POINTS).pixels
    pixels = project(msgspec.structs.replace(LENSES[model], matrix=K.tolist()), POINTS).pixels
    np.testing.assert_allclose(pixels, np.column_stack([bent, np.ones(30)]) @ K[:2].T, atol=1e-9)


@pytest.mark.parametrize("model", LENSES)
def test_nothing_is_seen_behind_the_camera(model):
    """Else a board has a mirrored twin there, with the same pixels."""
    behind = project(LENSES[model], np.array([[0.1, 0.05, -1.0], [0.1, 0.05, 0.0]]))
    assert np.isnan(behind.pixels).all() and np.isnan(behind.by_point).all()
    assert project(LENSES[model], np.zeros((2, 0, 3))).pixels.shape == (2, 0, 2)
