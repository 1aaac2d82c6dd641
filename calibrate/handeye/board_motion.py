"""Are these the robot's poses at all, or where some program saw the board?

Whoever runs PnP over the same pictures gets a table that moves as the board does, and every test of agreement
passes, for it agrees with the pictures by construction: the camera is "mounted" in the table's own frame
(X is the identity) and the board lies in its other one (Y is the identity). Either alone is possible. A TCP
that was set to the camera makes X the identity, and a work object that was taught on the board does so with
Y. A camera that is mounted parallel to the flange makes X's rotation the identity and never its translation:
a camera has a size, and its optical centre is not in the flange. Both together, within the noise of the
board's own poses, are no cell.

The program may have had another lens and other squares: its distances are longer or shorter along the axis,
and all its lengths by one factor. It may count the board's corners from another one, from the middle, and
along other edges, and its camera may look along −z (OpenGL). All this is allowed for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, inverse, project_to_rotation, rotation_angle, rotation_log

_TURN_RAD = np.radians(2.0)
"""Median difference of rotations of two programs' poses of one board, at most."""
_AXES_RAD = np.radians(4.0)
"""Difference of the board's axes from those of another way to count its corners."""
_SHIFT = 0.015
"""Median difference of positions over the distance, at most."""
_FOCAL = 1.25
"""Factor by which the lens of two programs differs, at most."""
_EXTENT = 0.5
"""Of a board of unknown size, over its distance."""
_LEVER_M = 0.5
"""Lever by which rotations are converted to lengths."""
_FEWEST = 4
_CAMERAS = np.array([np.eye(3), np.diag([1.0, -1.0, -1.0])])
"""A camera's own axes, and those of OpenGL."""


@dataclass(frozen=True)
class BoardMotion:
    """How near poses come to the board's own."""

    away_m: float
    """Median."""
    away_rad: float
    """Median."""


def boards_own_motion(flange: Array, boards: Array, extent_m: float = 0.0) -> BoardMotion | None:
    """Tell whether poses (n, 4, 4) are those of the board in the camera, or their inverses.

    `flange`: what is said to be base_from_flange. `boards`: (n, 4, 4) camera_from_board. `extent_m`: the
    board's diagonal, 0 where it is not known. None: they are a robot's.
    """
    if len(flange) < _FEWEST:
        return None
    found = (
        _nearness(poses, boards, extent_m, axes) for poses in (flange, inverse(flange)) for axes in _CAMERAS
    )
    return next((near for near in found if near is not None), None)


def pairs_moves_m(H: Array, C: Array, size_known: bool) -> Array:
    """Compute how far the board moves between views that are near, by the X that fits all such pairs best.

    H: (n, 4, 4) mounted poses, as of `mount_poses`; C: (n, 4, 4) camera_from_board; size_known: lengths of
    both are of one unit, else their ratio is found, too. Returns (m,) metres, radians count at half a metre.
    Rotation and translation apart: F. Park, B. Martin, "Robot sensor calibration: solving AX = XB on the
    Euclidean group" (1994).
    """
    i, k = np.array([(i, i + step) for step in (1, 2, 3) for i in range(len(H) - step)]).T
    A = inverse(H[k]) @ H[i]
    B = C[k] @ inverse(C[i])
    alpha, beta = rotation_log(A[:, :3, :3]), rotation_log(B[:, :3, :3])
    U, _, Vt = np.linalg.svd(alpha.T @ beta)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    shift = B[:, :3, 3] @ R.T
    J = A[:, :3, :3] - np.eye(3)
    right = shift - A[:, :3, 3]
    if not size_known:
        J = np.concatenate([J, -shift[..., None]], axis=2)
        right = -A[:, :3, 3]
    t = np.linalg.lstsq(J.reshape(-1, J.shape[2]), right.ravel(), rcond=None)[0]
    turned = np.linalg.norm(alpha - beta @ R.T, axis=1)
    return np.asarray(np.linalg.norm(J @ t - right, axis=1) + _LEVER_M * turned)


def board_extent_m(views: ViewSet) -> float:
    """Diagonal of the board as far as any view shows it; 0 of pairs without corners."""
    sizes = [
        float(np.linalg.norm(np.ptp(view.corners.points, axis=0)))
        for view in views
        if len(view.corners.points)
    ]
    return max(sizes, default=0.0)


def _nearness(poses: Array, boards: Array, extent_m: float, axes: Array) -> BoardMotion | None:
    """Compare poses to axes @ lens @ boards @ corner, `lens` a scale across and one along the axis."""
    R = boards[:, :3, :3]
    t = boards[:, :3, 3]
    turns = np.swapaxes(R, 1, 2) @ axes.T @ poses[:, :3, :3]
    corner = project_to_rotation(np.median(turns, axis=0))
    away_rad = float(np.median(rotation_angle(np.swapaxes(turns, 1, 2) @ corner)))
    counted = np.round(corner)
    if away_rad > _TURN_RAD or not np.allclose(np.abs(counted).sum(axis=0), 1):
        return None
    if rotation_angle(corner.T @ counted) > _AXES_RAD:
        return None
    told = poses[:, :3, 3] @ axes
    keep = np.ones(len(t), dtype=bool)
    for _ in range(3):
        across, along, at = _lens(told[keep], t[keep], R[keep])
        away = np.linalg.norm((t + R @ at) * [across, across, along] - told, axis=1)
        keep = away <= 4 * np.median(away)
    distance_m = float(np.median(np.linalg.norm(t, axis=1)))
    largest_m = extent_m or _EXTENT * distance_m
    away_m = float(np.median(away))
    if not (across > 0 and 1 / _FOCAL < along / across < _FOCAL and np.linalg.norm(at) < largest_m):
        return None
    return BoardMotion(away_m, away_rad) if away_m < _SHIFT * distance_m * across else None


def _lens(told: Array, t: Array, R: Array) -> tuple[float, float, Array]:
    """(scale across the axis, along it, place of the corner on the board (3,)) by least squares."""
    n = len(t)
    J = np.zeros((n, 3, 8))
    J[:, :2, 0] = t[:, :2]
    J[:, 2, 1] = t[:, 2]
    J[:, :2, 2:5] = R[:, :2]
    J[:, 2, 5:] = R[:, 2]
    found = np.linalg.lstsq(J.reshape(-1, 8), told.ravel(), rcond=None)[0]
    across, along = float(found[0]), float(found[1])
    weights = np.array([2.0 * across, along])
    at = (2.0 * found[2:5] + found[5:]) / weights.sum() if weights.sum() else np.zeros(3)
    return across, along, np.asarray(at)
