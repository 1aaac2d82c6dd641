"""Projection against OpenCV; its derivatives: see test_reprojection."""

import cv2
import numpy as np
import pytest

from calibrate.projection import intrinsics_vector, project, with_intrinsics_vector
from tests.calibrate.cells import LENSES


def points() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(30, 3)) * [0.2, 0.2, 0.1] + [0, 0, 1.0]


@pytest.mark.parametrize("model", LENSES)
def test_pixels_are_opencvs(model):
    camera = LENSES[model]
    zero, K, d = np.zeros(3), np.array(camera.matrix), np.array(camera.distortion)
    function = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    expected = function(points()[:, None], zero, zero, K, d)[0].reshape(-1, 2)
    again = with_intrinsics_vector(camera, intrinsics_vector(camera))
    for same in (camera, again):
        np.testing.assert_allclose(project(same, points()).pixels, expected, atol=1e-9)


@pytest.mark.parametrize("model", LENSES)
def test_nothing_is_seen_behind_the_camera(model):
    """Else a board has a mirrored twin there, with the same pixels."""
    assert np.isnan(project(LENSES[model], np.array([[0.1, 0.05, -1.0], [0.1, 0.05, 0.0]])).pixels).all()
