"""Corners against an X with the robot's poses taken as exact: how other tools state their error."""

from __future__ import annotations

import numpy as np

from calibrate.assess import board_places, mean_pose
from calibrate.consensus import pose_arrays
from calibrate.geometry import Array, inverse, perturb
from calibrate.likelihood.model import State, observe_views
from calibrate.likelihood.normal import CORNERS
from calibrate.likelihood.residuals import corner_residuals, linearise
from calibrate.views import ViewSet

_STEPS = 8


def reprojection_px(views: ViewSet, X: Array) -> float | None:
    """Root mean square distance over all corners with the best board place for this X; None without pixels.

    Infinite when corners fall behind the camera.
    """
    observed = observe_views(views)
    if not observed.has_pixels:
        return None
    H, C = pose_arrays(views)
    camera_from_place = inverse(H @ X)
    Y = mean_pose(board_places(H, C, X))
    best = np.inf
    for _ in range(_STEPS):
        state = State(X, Y, camera_from_place @ Y, views.camera, np.zeros(0))
        square = float((corner_residuals(observed, state) ** 2).sum())
        if not np.isfinite(square) or square >= best * (1 - 1e-9):
            break
        best = square
        normal = linearise(observed, state, observed.present, intrinsics_free=False)
        T = np.zeros((len(H), 6, 6))
        T[:, :3, :3] = T[:, 3:, 3:] = camera_from_place[:, :3, :3]
        T_t = np.swapaxes(T, 1, 2)
        N = (T_t @ normal.V[CORNERS] @ T).sum(axis=0)
        g = (T_t @ normal.h[CORNERS][..., None]).sum(axis=0)[:, 0]
        Y = perturb(Y, np.linalg.lstsq(N, g, rcond=None)[0])
    return float(np.sqrt(best / observed.present.sum()))
