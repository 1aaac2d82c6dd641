"""How well the lens is known, over the picture: by how many pixels a fixed direction may be shown wrongly.

A lens found from pictures and the cameras' poses are one fit: a wrong principal point is mostly made good by
turned cameras. What stays after the best turn is what counts, as in mrcal's projection uncertainty
(D. Kogan, mrcal's documentation, chapter "Projection uncertainty").
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.geometry import Array, skew
from calibrate.lens import undistort
from calibrate.lens_fit import reduced
from calibrate.likelihood.model import State, observe_views
from calibrate.likelihood.residuals import linearise_corners
from calibrate.projection import camera_matrix, project
from calibrate.views import ViewSet
from recordings.messages import CameraModel

_COLUMNS, _ROWS = 33, 25


@dataclass(frozen=True, eq=False)
class LensUncertainty:
    camera: CameraModel
    covariance: Array
    """(9, 9) of `projection.INTRINSICS`; zero rows for those held."""
    sigma_px: Array
    """(rows, columns) over the picture, borders included: root of the mean squared shift, 1σ."""

    @property
    def figures(self) -> dict[str, float]:
        """Pixels: at the centre, at the worst of the four corners, and anywhere at worst."""
        grid = self.sigma_px
        corner = max(grid[0, 0], grid[0, -1], grid[-1, 0], grid[-1, -1])
        centre = grid[grid.shape[0] // 2, grid.shape[1] // 2]
        return {"centre": float(centre), "corner": float(corner), "worst": float(grid.max())}


def lens_uncertainty(views: ViewSet, camera: CameraModel, corner_px: float) -> LensUncertainty | None:
    """From the corners alone (no robot), for noise of `corner_px` per axis.

    views: those that fixed the lens, with board poses. None for other lenses than plumb_bob, where a view
    has no pixels, and where the views do not fix the lens. J being how a pixel moves by the lens, T how by a
    turn, Σ the covariance of the lens: σ² = trace(S Σ Sᵀ), S = J + T φ, and φ the turn by the lens that makes
    S least over all corners that were seen.
    """
    if camera.distortion_model != "plumb_bob" or not all(len(view.pixels) for view in views):
        return None
    covariance = _intrinsics_covariance(views, camera, corner_px)
    if covariance is None:
        return None
    u = np.linspace(0, camera.width - 1, _COLUMNS)
    v = np.linspace(0, camera.height - 1, _ROWS)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    seen = np.concatenate([view.pixels for view in views])
    by_lens, by_turn = _derivatives(camera, seen)
    turns = np.einsum("nij,nik->jk", by_turn, by_turn)
    best_turn = -np.linalg.solve(turns, np.einsum("nij,nik->jk", by_turn, by_lens))
    by_lens, by_turn = _derivatives(camera, grid)
    shift = by_lens + by_turn @ best_turn
    square = np.einsum("nij,jk,nik->n", shift, covariance, shift)
    return LensUncertainty(camera, covariance, np.sqrt(np.maximum(square, 0.0)).reshape(_ROWS, _COLUMNS))


def _intrinsics_covariance(views: ViewSet, camera: CameraModel, corner_px: float) -> Array | None:
    """(9, 9), the board poses marginalised; at the poses as they are, which PnP found by the same corners."""
    observed = observe_views(replace(views, camera=camera))
    state = State(np.eye(4), np.eye(4), views.camera_from_board, camera, np.zeros(0))
    normal = linearise_corners(observed, state, observed.present, intrinsics_free=True)
    lens = np.setdiff1d(np.arange(9), observed.held)
    information, _ = reduced(normal, lens)
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if not values[0] > 1e-12:
        return None
    basis = vectors * scale[:, None]
    covariance = np.zeros((9, 9))
    covariance[np.ix_(lens, lens)] = corner_px**2 * (basis / values) @ basis.T
    return covariance


def _derivatives(camera: CameraModel, pixels: Array) -> tuple[Array, Array]:
    """By the lens (n, 2, 9) and by a turn of the camera (n, 2, 3), at the directions shown at `pixels`."""
    plain = np.concatenate([undistort(camera, pixels), np.ones((len(pixels), 1))], axis=1)
    rays = plain @ np.linalg.inv(camera_matrix(camera)).T
    projected = project(camera, rays, with_intrinsics=True)
    return np.asarray(projected.by_intrinsics), projected.by_point @ -skew(rays)
