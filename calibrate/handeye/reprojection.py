"""Reprojection residuals (observed minus modelled pixels) and their normal equations, one block a view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.results import SHAPE
from calibrate.views.projection import intrinsics_names, project
from calibrate.views.view_set import Observations
from recordings.geometry import Array, skew
from recordings.schema.messages import CameraModel

_CHUNK_POINTS = 40_000
"""Most corners linearised at once, so that thousands of views fit into memory."""


@dataclass(frozen=True, eq=False)
class CornerBlocks:
    """Normal equations of the corners: pose columns L of C_i, shared columns G of lens and board shape."""

    LL: Array
    """(n, 6, 6)"""
    LG: Array
    """(n, 6, g)"""
    GG: Array
    """(n, g, g)"""
    Lr: Array
    """(n, 6)"""
    Gr: Array
    """(n, g)"""
    rr: Array
    """(n,) weighted sums of squares, px²."""
    rows: Array
    """(n,) twice the weighted number of corners."""

    def without_boards(self, U: Array) -> Eliminated:
        """Eliminate the board poses; U (n, 6, 6): LL⁻¹, or the inverse of a damped LL."""
        to_optimum, by_shared = (U @ self.Lr[..., None])[..., 0], U @ self.LG
        GL = np.swapaxes(self.LG, 1, 2)
        right = self.Gr - (GL @ to_optimum[..., None])[..., 0]
        return Eliminated(to_optimum, by_shared, self.GG - GL @ by_shared, right)


@dataclass(frozen=True, eq=False)
class Eliminated:
    """Normal equations of the shared columns, each view's board pose at its optimum for them (Schur)."""

    to_optimum: Array
    """(n, 6) step of each board pose to its own corners' optimum."""
    by_shared: Array
    """(n, 6, g) negative derivative of that optimum by the shared unknowns."""
    information: Array
    """(n, g, g)"""
    right: Array
    """(n, g)"""

    def board_step(self, shared: Array) -> Array:
        """Compute the step (n, 6) of the board poses that belongs to a step (g,) of the shared unknowns."""
        return np.asarray(self.to_optimum - self.by_shared @ shared)


def bent_points(observed: Observations, shape: Array) -> Array:
    """Place the corners (n, k, 3) of a board of this `shape` (5,) in its own frame."""
    s, a, *bends = shape
    x, y = observed.points[..., 0], observed.points[..., 1]
    u, v = _unit_square(observed)
    z = observed.points[..., 2] + bends[0] * (1 - u * u) + bends[1] * (1 - v * v) + bends[2] * u * v
    return np.stack([x * (1 + s + a / 2), y * (1 + s - a / 2), z], axis=-1)


def _unit_square(observed: Observations) -> tuple[Array, Array]:
    middle, half = observed.extent
    uv = (observed.points[..., :2] - middle) / half
    return uv[..., 0], uv[..., 1]


def _in_camera(observed: Observations, points: Array, C: Array) -> tuple[Array, Array]:
    """Rotate, and transform, points (n, k, 3) into `camera`; padding is put in front of it."""
    turned = points @ np.swapaxes(C[:, :3, :3], 1, 2)
    placed = turned + C[:, None, :3, 3]
    return turned, np.where(observed.present[..., None] > 0, placed, [0.0, 0.0, 1.0])


def corner_residuals(
    observed: Observations, camera: CameraModel, C: Array, shape: Array | None = None
) -> Array:
    """Compute observed minus modelled pixels (n, k, 2), 0 for padding; not finite behind the camera."""
    if not observed.has_pixels:
        return np.zeros_like(observed.pixels)
    points = observed.points if shape is None else bent_points(observed, shape)
    _, p = _in_camera(observed, points, C)
    return np.where(observed.present[..., None] > 0, observed.pixels - project(camera, p).pixels, 0.0)


def corner_distance(residuals: Array) -> Array:
    """Measure lengths (...) of (..., 2): np.linalg.norm's numbers in a third of its time."""
    square = residuals * residuals
    return np.asarray(np.sqrt(square[..., 0] + square[..., 1]))


def linearise_corners(
    observed: Observations,
    camera: CameraModel,
    C: Array,
    weights: Array,
    with_lens: bool = False,
    shape: Array | None = None,
) -> CornerBlocks:
    """Linearise at C (n, 4, 4) for `weights` (n, k) in 0 … 1.

    Shared columns: none, those of the lens (`with_lens`), or lens and board shape (with `shape` (5,) too).
    """
    n = len(C)
    g = len(intrinsics_names(camera)) * with_lens + len(SHAPE) * (shape is not None)
    blocks = CornerBlocks(
        np.zeros((n, 6, 6)),
        np.zeros((n, 6, g)),
        np.zeros((n, g, g)),
        np.zeros((n, 6)),
        np.zeros((n, g)),
        np.zeros(n),
        2 * (weights * observed.present).sum(axis=1),
    )
    step = max(1, _CHUNK_POINTS // observed.points.shape[1])
    for start in range(0, n, step):
        part = slice(start, start + step)
        chunk = observed.part(np.arange(n)[part])
        points = chunk.points if shape is None else bent_points(chunk, shape)
        turned, p = _in_camera(chunk, points, C[part])
        projected = project(camera, p)
        root = np.sqrt(weights[part] * chunk.present)[..., None]
        r = ((chunk.pixels - projected.pixels) * root).reshape(len(chunk), -1)
        L = np.concatenate([projected.by_point, projected.by_point @ -skew(turned)], axis=-1)
        L = (L * root[..., None]).reshape(len(chunk), -1, 6)
        L_t = np.swapaxes(L, 1, 2)
        blocks.LL[part] = L_t @ L
        blocks.Lr[part] = (L_t @ r[..., None])[..., 0]
        blocks.rr[part] = (r * r).sum(axis=1)
        columns = [projected.by_intrinsics] if with_lens else []
        if shape is not None:
            columns.append(projected.by_point @ (C[part, None, :3, :3] @ _by_shape(chunk)))
        if columns:
            G = (np.concatenate(columns, axis=-1) * root[..., None]).reshape(len(chunk), L.shape[1], -1)
            G_t = np.swapaxes(G, 1, 2)
            blocks.LG[part] = L_t @ G
            blocks.GG[part] = G_t @ G
            blocks.Gr[part] = (G_t @ r[..., None])[..., 0]
    return blocks


def _by_shape(observed: Observations) -> Array:
    """Compute the motion (n, k, 3, 5) of each corner, in the board's frame, by each number of its shape."""
    x, y = observed.points[..., 0], observed.points[..., 1]
    u, v = _unit_square(observed)
    D = np.zeros((*x.shape, 3, len(SHAPE)))
    D[..., 0, 0], D[..., 1, 0] = x, y
    D[..., 0, 1], D[..., 1, 1] = x / 2, -y / 2
    D[..., 2, 2], D[..., 2, 3], D[..., 2, 4] = 1 - u * u, 1 - v * v, u * v
    return D
