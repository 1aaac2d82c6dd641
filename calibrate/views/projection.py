"""Pinhole projection with lens distortion and its exact derivatives, for many points at once; its inverse.

All by OpenCV, whose coefficients are in this order: plumb_bob k1 k2 p1 p2 k3, rational_polynomial + k4 k5 k6,
equidistant (fisheye) k1 … k4. Pixel (0, 0) is the centre of the top left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import msgspec
import numpy as np

from calibrate.errors import BadViewsError
from recordings.geometry import Array, transform_points
from recordings.schema.messages import CameraModel

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""The parameters of a plumb_bob lens, in this order."""
_PARAMETERS = {
    "plumb_bob": INTRINSICS,
    "rational_polynomial": (*INTRINSICS, "k4", "k5", "k6"),
    "equidistant": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}


@dataclass(frozen=True, eq=False)
class Projected:
    pixels: Array
    """(..., 2)"""
    by_point: Array
    """(..., 2, 3) ∂pixel/∂point, 1/m"""
    by_intrinsics: Array
    """(..., 2, p) in the order of `intrinsics_names`."""


def project(camera: CameraModel, points: Array) -> Projected:
    """Project points (..., 3) in `camera`, metres. At or behind the camera nothing is finite."""
    K, shape, p = camera_matrix(camera), points.shape[:-1], len(intrinsics_names(camera))
    if not points.size:  # OpenCV would return None
        return Projected(np.zeros((*shape, 2)), np.zeros((*shape, 2, 3)), np.zeros((*shape, 2, p)))
    # OpenCV would give a point behind the camera the pixel of its mirrored twin.
    front = points[..., 2:] > 0
    at = np.where(front, points, [0.0, 0.0, 1.0]).reshape(-1, 1, 3)
    fisheye = camera.distortion_model == "equidistant"
    function: Any = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    pixels, J = function(at, np.zeros(3), np.zeros(3), K, distortion(camera))
    pixels, J = pixels.reshape(-1, 2), J.reshape(len(at), 2, -1)
    by_point, own = (J[..., 11:14], J[..., :p]) if fisheye else (J[..., 3:6], J[..., 6:])
    if K[0, 1]:  # OpenCV knows no skew
        shear = K[0, 1] / K[1, 1]
        pixels[:, 0] += shear * (pixels[:, 1] - K[1, 2])
        J[:, 0] += shear * J[:, 1]
        own[:, 0, [1, 3]] = 0.0  # fy and cy move y alone
    behind = ~front.ravel()
    pixels[behind], J[behind] = np.nan, np.nan
    return Projected(pixels.reshape(*shape, 2), by_point.reshape(*shape, 2, 3), own.reshape(*shape, 2, p))


def camera_matrix(camera: CameraModel) -> Array:
    """Return K (3, 3); BadViewsError where it is missing or not a camera matrix."""
    if camera.matrix is None:
        raise BadViewsError("no-intrinsics")
    K = np.array(camera.matrix, dtype=float)
    if (
        K.shape != (3, 3)
        or not np.isfinite(K).all()
        or not (K[0, 0] > 0 and K[1, 1] > 0)
        or K[1, 0] != 0
        or K[2].tolist() != [0, 0, 1]
    ):
        raise BadViewsError("camera-matrix", matrix=str(camera.matrix))
    return K


def intrinsics_names(camera: CameraModel) -> tuple[str, ...]:
    """Name the parameters of the camera's lens model, in the order of `intrinsics_vector`.

    A plumb_bob lens with more than five numbers, as OpenCV gives them, is rational.
    """
    model = camera.distortion_model
    rational = model == "plumb_bob" and len(camera.distortion) > len(INTRINSICS) - 4
    return _PARAMETERS["rational_polynomial" if rational else model]


def intrinsics_vector(camera: CameraModel) -> Array:
    """Return (p,) in the order of `intrinsics_names`: pixels for the first four, the others plain."""
    K = camera_matrix(camera)
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], distortion(camera)])


def with_intrinsics_vector(camera: CameraModel, vector: Array) -> CameraModel:
    """Replace the numbers of the lens model, skew kept."""
    fx, fy, cx, cy, *distortion = (float(v) for v in vector)
    skewed = float(camera_matrix(camera)[0, 1])
    matrix = ((fx, skewed, cx), (0.0, fy, cy), (0.0, 0.0, 1.0))
    return msgspec.structs.replace(camera, matrix=matrix, distortion=tuple(distortion))


_UNDISTORT_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-10)


def distortion(camera: CameraModel) -> Array:
    """Return OpenCV's coefficients: (4,) for equidistant, otherwise (5,) or (8,), zeros appended."""
    values, size = np.array(camera.distortion, dtype=float), len(intrinsics_names(camera)) - 4
    if len(values) > size or not np.isfinite(values).all():
        raise BadViewsError(
            "distortion", distortion=str(camera.distortion), model=camera.distortion_model, size=size
        )
    return np.concatenate([values, np.zeros(size - len(values))])


def project_at(camera: CameraModel, camera_from_board: Array, points: Array) -> Array:
    """Project points (n, 3) of `board` to pixels (n, 2)."""
    return project(camera, transform_points(camera_from_board, np.asarray(points, dtype=float))).pixels


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
