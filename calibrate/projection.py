"""Pinhole projection with lens distortion and its exact derivatives, for many points at once; its inverse.

OpenCV's models and coefficient order: plumb_bob k1 k2 p1 p2 k3, rational_polynomial + k4 k5 k6,
equidistant (fisheye) k1 … k4. Pixel (0, 0) is the centre of the top left pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import msgspec
import numpy as np

from calibrate.errors import BadViewsError
from calibrate.geometry import Array, transform_points
from recordings.schema.messages import CameraModel

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""The parameters of a plumb_bob lens, in this order."""
_PARAMETERS = {
    "plumb_bob": INTRINSICS,
    "rational_polynomial": (*INTRINSICS, "k4", "k5", "k6"),
    "equidistant": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
_Bent = tuple[Array, Array, Callable[[], Array]]
"""Distorted x, y of rays (x, y, 1), and on demand their derivatives by x and y (..., 2, 2)."""


@dataclass(frozen=True, eq=False)
class Projected:
    pixels: Array
    """(..., 2)"""
    by_point: Array
    """(..., 2, 3) ∂pixel/∂point, 1/m"""
    by_intrinsics: Array | None
    """(..., 2, p) in the order of `intrinsics_names`; None unless asked for."""


def project(camera: CameraModel, points: Array, with_intrinsics: bool = False) -> Projected:
    """Project points (..., 3) in `camera`, metres. At or behind the camera pixels are not finite."""
    K = camera_matrix(camera)
    x, y, w = _rays(points)
    xd, yd, derivatives = _bend(camera, x, y)
    by_x = derivatives()
    by_x[..., 0, :] = K[0, 0] * by_x[..., 0, :] + K[0, 1] * by_x[..., 1, :]
    by_x[..., 1, :] *= K[1, 1]
    J = np.empty((*points.shape[:-1], 2, 3))
    J[..., :2] = by_x * w[..., None, None]
    J[..., 2] = -(by_x[..., 0] * (x * w)[..., None] + by_x[..., 1] * (y * w)[..., None])
    pixels = _pixels(K, xd, yd)
    return Projected(pixels, J, _by_intrinsics(camera, K, x, y, xd, yd) if with_intrinsics else None)


def project_pixels(camera: CameraModel, points: Array) -> Array:
    """Compute the pixels of `project`, to the bit, without the derivatives."""
    x, y, _ = _rays(points)
    xd, yd, _ = _bend(camera, x, y)
    return _pixels(camera_matrix(camera), xd, yd)


def _rays(points: Array) -> tuple[Array, Array, Array]:
    """x/z, y/z and 1/z; NaN at and behind the camera, which would see a mirrored twin there."""
    z = points[..., 2]
    w = 1.0 / np.where(z > 0, z, np.nan)
    return points[..., 0] * w, points[..., 1] * w, w


def _bend(camera: CameraModel, x: Array, y: Array) -> _Bent:
    bend = _equidistant if camera.distortion_model == "equidistant" else _brown
    return bend(x, y, camera.distortion)


def _pixels(K: Array, xd: Array, yd: Array) -> Array:
    return np.stack([K[0, 0] * xd + K[0, 1] * yd + K[0, 2], K[1, 1] * yd + K[1, 2]], axis=-1)


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


def _brown(x: Array, y: Array, coefficients: tuple[float, ...]) -> _Bent:
    """Radial (rational) and tangential distortion."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *(0.0,) * 8)[:8]
    r2 = x * x + y * y
    top = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = top / bottom
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

    def derivatives() -> Array:
        slope = (k1 + r2 * (2 * k2 + 3 * k3 * r2) - radial * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) / bottom
        D = np.empty((*x.shape, 2, 2))
        D[..., 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        D[..., 0, 1] = D[..., 1, 0] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        D[..., 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        return D

    return xd, yd, derivatives


def _equidistant(x: Array, y: Array, coefficients: tuple[float, ...]) -> _Bent:
    """Kannala-Brandt: θd = θ (1 + k1 θ² + … + k4 θ⁸), scaled along the ray's direction."""
    k1, k2, k3, k4 = (*coefficients, *(0.0,) * 4)[:4]
    r = np.sqrt(x * x + y * y)
    safe = np.maximum(r, 1e-9)
    theta = np.arctan(safe)
    t2 = theta * theta
    bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    scale = bent / safe

    def derivatives() -> Array:
        slope = (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))) / (1 + safe * safe)
        along = (slope - scale) / (safe * safe)
        D = np.empty((*x.shape, 2, 2))
        D[..., 0, 0] = scale + along * x * x
        D[..., 0, 1] = D[..., 1, 0] = along * x * y
        D[..., 1, 1] = scale + along * y * y
        return D

    return x * scale, y * scale, derivatives


def _by_intrinsics(camera: CameraModel, K: Array, x: Array, y: Array, xd: Array, yd: Array) -> Array:
    r2 = x * x + y * y
    J = np.zeros((*x.shape, 2, len(intrinsics_names(camera))))
    J[..., 0, 0], J[..., 0, 2] = xd, 1.0
    J[..., 1, 1], J[..., 1, 3] = yd, 1.0
    if camera.distortion_model == "equidistant":
        r = np.maximum(np.sqrt(r2), 1e-9)
        theta = np.arctan(r)
        terms = [(x * s, y * s) for s in (theta ** (2 * power + 1) / r for power in range(1, 5))]
    else:
        k1, k2, _, _, k3, k4, k5, k6 = (*camera.distortion, *(0.0,) * 8)[:8]
        bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / bottom
        tops = [(x * s, y * s) for s in (r2 / bottom, r2**2 / bottom)]
        tangential = [(2 * x * y, r2 + 2 * y * y), (r2 + 2 * x * x, 2 * x * y)]
        terms = [*tops, *tangential, (x * r2**3 / bottom, y * r2**3 / bottom)]
        if "k6" in intrinsics_names(camera):
            terms += [(-x * s, -y * s) for s in (radial * r2**power / bottom for power in (1, 2, 3))]
    for place, (a, b) in enumerate(terms, start=4):
        J[..., 0, place] = K[0, 0] * a + K[0, 1] * b
        J[..., 1, place] = K[1, 1] * b
    return J


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
