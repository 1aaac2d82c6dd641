"""Projection and its derivatives against OpenCV and against differences."""

import cv2
import msgspec
import numpy as np
import pytest

from calibrate.projection import (
    INTRINSICS,
    intrinsics_vector,
    project,
    with_intrinsics_vector,
)
from recordings.schema.messages import CameraModel

PLAIN = CameraModel(
    1280,
    1024,
    ((1600.0, 0.0, 640.0), (0.0, 1610.0, 500.0), (0.0, 0.0, 1.0)),
    (-0.1, 0.05, 1e-3, -2e-3, 1e-2),
)
RATIONAL = msgspec.structs.replace(
    PLAIN,
    distortion=(-0.1, 0.05, 1e-3, -2e-3, 1e-2, 0.02, 0.03, -0.01),
    distortion_model="rational_polynomial",
)
FISHEYE = msgspec.structs.replace(PLAIN, distortion=(-0.1, 0.05, 0.01, -0.02), distortion_model="equidistant")


def points() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(30, 3)) * [0.2, 0.2, 0.1] + [0, 0, 1.0]


@pytest.mark.parametrize("camera", [PLAIN, RATIONAL, FISHEYE])
def test_pixels_are_opencvs(camera):
    zero, K, d = np.zeros(3), np.array(camera.matrix), np.array(camera.distortion)
    function = cv2.fisheye.projectPoints if camera is FISHEYE else cv2.projectPoints
    expected = function(points()[:, None], zero, zero, K, d)[0].reshape(-1, 2)
    np.testing.assert_allclose(project(camera, points()).pixels, expected, atol=1e-9)


@pytest.mark.parametrize("camera", [PLAIN, RATIONAL, FISHEYE])
def test_derivative_by_the_point(camera):
    h = 1e-6
    numeric = [
        (project(camera, points() + h * e).pixels - project(camera, points() - h * e).pixels) / (2 * h)
        for e in np.eye(3)
    ]
    np.testing.assert_allclose(project(camera, points()).by_point, np.stack(numeric, -1), atol=1e-5)


def test_derivative_by_the_intrinsics_is_opencvs():
    K, d = np.array(PLAIN.matrix), np.array(PLAIN.distortion)
    J = cv2.projectPoints(points()[:, None], np.zeros(3), np.zeros(3), K, d)[1]
    ours = project(PLAIN, points(), with_intrinsics=True).by_intrinsics
    np.testing.assert_allclose(ours.reshape(-1, 9), J[:, 6 : 6 + len(INTRINSICS)], atol=1e-9)


def test_intrinsics_survive_the_way_through_a_vector():
    moved = intrinsics_vector(PLAIN) + np.arange(9)
    np.testing.assert_array_equal(intrinsics_vector(with_intrinsics_vector(PLAIN, moved)), moved)
