"""Uncertainty of the lens over the image: pixels by which a fixed direction may be shown wrongly.

Lens and camera poses are one fit: a wrong principal point is mostly made good by turned cameras. What stays
after the best turn is what counts, as in mrcal's projection uncertainty (D. Kogan, mrcal's documentation,
chapter "Projection uncertainty").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.geometry import Array, skew
from calibrate.projection import camera_matrix, project, undistort
from recordings.schema.messages import CameraModel

_COLUMNS, _ROWS = 33, 25


@dataclass(frozen=True, eq=False)
class LensUncertainty:
    camera: CameraModel
    sigma_px: Array
    """(rows, columns) over the image, borders included: root of the mean squared shift, 1σ."""

    @property
    def figures(self) -> dict[str, float]:
        """Pixels: at the centre, at the worst of the four corners, and anywhere at worst."""
        grid = self.sigma_px
        corner = max(grid[0, 0], grid[0, -1], grid[-1, 0], grid[-1, -1])
        centre = grid[grid.shape[0] // 2, grid.shape[1] // 2]
        return {"centre": float(centre), "corner": float(corner), "worst": float(grid.max())}


def lens_uncertainty(camera: CameraModel, covariance: Array, seen: Array) -> LensUncertainty:
    """Propagate the lens's covariance (p, p) to the image; seen: (m, 2) all corners that were seen, px.

    J being how a pixel moves by the lens, T how by a turn, Σ the covariance of the lens: σ² = trace(S Σ Sᵀ),
    S = J + T φ, and φ the turn by the lens that makes S least over the corners seen.
    """
    u = np.linspace(0, camera.width - 1, _COLUMNS)
    v = np.linspace(0, camera.height - 1, _ROWS)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    by_lens, by_turn = _derivatives(camera, seen)
    turns = np.einsum("nij,nik->jk", by_turn, by_turn)
    best_turn = -np.linalg.solve(turns, np.einsum("nij,nik->jk", by_turn, by_lens))
    by_lens, by_turn = _derivatives(camera, grid)
    shift = by_lens + by_turn @ best_turn
    square = np.einsum("nij,jk,nik->n", shift, covariance, shift)
    return LensUncertainty(camera, np.sqrt(np.maximum(square, 0.0)).reshape(_ROWS, _COLUMNS))


def _derivatives(camera: CameraModel, pixels: Array) -> tuple[Array, Array]:
    """Derive by the lens (n, 2, p) and by a turn of the camera (n, 2, 3) at the directions of `pixels`."""
    plain = np.concatenate([undistort(camera, pixels), np.ones((len(pixels), 1))], axis=1)
    rays = plain @ np.linalg.inv(camera_matrix(camera)).T
    projected = project(camera, rays, with_intrinsics=True)
    return np.asarray(projected.by_intrinsics), projected.by_point @ -skew(rays)
