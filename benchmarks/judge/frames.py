"""Rotations and poses as the textbook has them, for arrays of any number of leading axes.

R. M. Murray, Z. Li, S. S. Sastry: "A Mathematical Introduction to Robotic Manipulation" (1994), chapter 2. A
pose is a matrix (..., 4, 4), `a_from_b`: it takes points in frame b to frame a. Metres and radians.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Places = NDArray[np.intp]
"""Places in an array."""


def cross_matrix(v: ArrayLike) -> Array:
    """Matrices (..., 3, 3) with cross_matrix(v) w = v × w."""
    v = np.asarray(v, dtype=float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1] = -v[..., 2]
    out[..., 0, 2] = v[..., 1]
    out[..., 1, 0] = v[..., 2]
    out[..., 1, 2] = -v[..., 0]
    out[..., 2, 0] = -v[..., 1]
    out[..., 2, 1] = v[..., 0]
    return out


def rotation(v: ArrayLike) -> Array:
    """Rotations (..., 3, 3) by the vectors v (..., 3): axis times angle (Rodrigues)."""
    v = np.asarray(v, dtype=float)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    K = cross_matrix(v)
    # sinc keeps sin(x)/x exact at 0; (1 - cos x)/x² is half the square of sin(x/2)/(x/2).
    sine = np.sinc(angle / np.pi)
    cosine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + sine * K + cosine * K @ K)


def rotation_vector(R: Array) -> Array:
    """Vectors (..., 3) of rotations (..., 3, 3) by less than half a turn: the inverse of `rotation`."""
    skew = np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )
    sine = 0.5 * np.linalg.norm(skew, axis=-1)
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    angle = np.arctan2(sine, cosine)
    ratio = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)
    return np.asarray(0.5 * ratio[..., None] * skew)


def pose(R: ArrayLike, t: ArrayLike) -> Array:
    """Poses (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    R = np.asarray(R, dtype=float)
    t = np.asarray(t, dtype=float)
    out = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3] = R
    out[..., :3, 3] = t
    out[..., 3, 3] = 1.0
    return out


def small_motion(delta: ArrayLike) -> Array:
    """Poses of (..., 6) [translation, rotation vector]."""
    delta = np.asarray(delta, dtype=float)
    return pose(rotation(delta[..., 3:]), delta[..., :3])


def inverse(T: Array) -> Array:
    """Inverse poses."""
    turned = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(turned, -(turned @ T[..., :3, 3:])[..., 0])


def apply(T: Array, points: ArrayLike) -> Array:
    """Points (..., 3), one for each pose of T (..., 4, 4)."""
    points = np.asarray(points, dtype=float)
    return np.asarray((T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3])


def difference(T: Array, reference: Array) -> Array:
    """(..., 6) [t - t₀, rotation vector of R R₀ᵀ], both in the parent's frame."""
    R = T[..., :3, :3] @ np.swapaxes(reference[..., :3, :3], -1, -2)
    return np.concatenate([T[..., :3, 3] - reference[..., :3, 3], rotation_vector(R)], axis=-1)


def unit(v: Any) -> Array:
    """Vectors (..., 3) at length one."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
