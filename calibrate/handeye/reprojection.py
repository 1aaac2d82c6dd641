"""Corners against an X with the robot's poses taken as exact: how other tools state their error."""

from __future__ import annotations

import numpy as np

from calibrate.geometry import Array, inverse, perturb
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.corners import corner_residuals, linearise_corners
from calibrate.handeye.metrics import board_places, mean_pose
from calibrate.handeye.observations import observe_views
from calibrate.views import ViewSet

_STEPS = 8


def reprojection_px(views: ViewSet, X: Array) -> float | None:
    """Root mean square distance over all corners with the best board pose for this X; None without pixels.

    Infinite when corners fall behind the camera.
    """
    observed = observe_views(views)
    if not observed.has_pixels:
        return None
    H, C = mount_poses(views.base_from_flange, views.mount), views.camera_from_board
    camera_from_place = inverse(H @ X)
    Y = mean_pose(board_places(H, C, X))
    best = np.inf
    for _ in range(_STEPS):
        C = camera_from_place @ Y
        square = float((corner_residuals(observed, views.camera, C) ** 2).sum())
        if not np.isfinite(square) or square >= best * (1 - 1e-9):
            break
        best = square
        blocks = linearise_corners(observed, views.camera, C, observed.present)
        T = np.zeros((len(H), 6, 6))
        T[:, :3, :3] = T[:, 3:, 3:] = camera_from_place[:, :3, :3]
        T_t = np.swapaxes(T, 1, 2)
        N = (T_t @ blocks.LL @ T).sum(axis=0)
        g = (T_t @ blocks.Lr[..., None]).sum(axis=0)[:, 0]
        Y = perturb(Y, np.linalg.lstsq(N, g, rcond=None)[0])
    return float(np.sqrt(best / observed.present.sum()))
