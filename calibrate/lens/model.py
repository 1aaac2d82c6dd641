"""Images of a board, and pixels with the lens taken out."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from calibrate.errors import BadViewsError
from calibrate.geometry import Array, transform_points
from calibrate.projection import camera_matrix, project_pixels
from recordings.schema.messages import CameraModel

_UNDISTORT_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-10)


def distortion(camera: CameraModel) -> Array:
    """Return OpenCV's coefficients: (4,) for equidistant, otherwise (5,) or (8,), zeros appended."""
    values = np.array(camera.distortion, dtype=float)
    size = 4 if camera.distortion_model == "equidistant" else (8 if len(values) > 5 else 5)
    if len(values) > size or not np.isfinite(values).all():
        raise BadViewsError(
            f"The distortion {camera.distortion} does not fit {camera.distortion_model}.",
            code="distortion",
            remedy=f"Write at most {size} finite numbers.",
        )
    return np.concatenate([values, np.zeros(size - len(values))])


def project(camera: CameraModel, camera_from_board: Array, points: Array) -> Array:
    """Project points (n, 3) of `board` to pixels (n, 2)."""
    return project_pixels(camera, transform_points(camera_from_board, np.asarray(points, dtype=float)))


def undistort(camera: CameraModel, pixels: Array) -> Array:
    """Map pixels (n, 2) to those that a lens without distortion and the same matrix would show.

    OpenCV passes over a skew in the matrix: good enough for a start.
    """
    K, D = camera_matrix(camera), distortion(camera)
    points = np.ascontiguousarray(pixels, dtype=float).reshape(-1, 1, 2)
    if camera.distortion_model == "equidistant":
        plain: Any = cv2.fisheye.undistortPoints(points, K, D, P=K)
    else:
        plain = cv2.undistortPointsIter(points, K, D, np.eye(3), K, _UNDISTORT_STEPS)
    return np.asarray(plain, dtype=np.float64).reshape(-1, 2)
