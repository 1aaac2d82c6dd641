"""The cell by views so far: camera and board pose, a rough lens, and what is probably wrong.

Wrong may be an answer given for a new cell, one told pose, or the way in which all poses are read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibrate.errors import CalibrationError
from calibrate.handeye.pose_fit import FREE, fit_poses, pose_views
from calibrate.handeye.solution import Reading
from calibrate.views.view_set import BoardView, ViewSet, implied_flange
from recordings.geometry import difference
from recordings.schema.messages import BoardSpec, CameraModel, Mount
from station.analysis.estimation import (
    FEWEST_FOR_CELL,
    FOCAL_SIGMA,
    QuickFit,
    quick_covariance,
    solve_quickly,
)
from station.cell.errors import StationError

GOOD_M, GOOD_RAD = 0.010, math.radians(2.0)
"""1σ of the camera's pose below which the views are enough for planning."""
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 0.003, 0.01
"""Smallest 1σ that is stated, because the true arm differs from its nominal table."""
_MOVED_M = 0.006
"""Spread of the board's position over the views above which it, or the camera, was moved."""
_WRONG_SCALE = 0.03
"""Relative deviation of the squares from their stated size above which a warning is given."""
_OTHER_MOUNT = 3.0
"""Ratio of the fits from which the other mounting is taken to be the right one."""


@dataclass(frozen=True, eq=False)
class FoundCell(QuickFit):
    """Camera, board and mounting estimated from the views."""

    sigma_m: float
    sigma_rad: float
    scale: float
    """Size of the squares, measured by the arm's motion, over the stated size."""
    other_fits: bool
    """True when the other mounting explains the views far better."""

    @property
    def good(self) -> bool:
        return self.sigma_m <= GOOD_M and self.sigma_rad <= GOOD_RAD and self.problem is None

    @property
    def problem(self) -> StationError | None:
        """Make the error for what is probably wrong; None: nothing."""
        if self.other_fits:
            return StationError("other-mounting")
        if abs(self.scale - 1) > _WRONG_SCALE:
            return StationError("square-size", scale=self.scale)
        if self.spread_m > _MOVED_M:
            return StationError("board-or-camera-moved", spread_m=self.spread_m)
        return None


def find_cell(
    mount: Mount, board: BoardSpec, camera: CameraModel, lens_known: bool, seen: Sequence[BoardView]
) -> FoundCell | None:
    """Estimate camera and board pose, and the lens where it is not known, in about 0.1 s.

    `camera`: without a matrix nothing is known of the lens. None: the views are not enough.
    """
    if len(seen) < FEWEST_FOR_CELL:
        return None
    try:
        quick = solve_quickly(mount, camera, lens_known, board, seen)
        other: Mount = "eye-to-hand" if mount == "eye-in-hand" else "eye-in-hand"
        other_m = solve_quickly(other, quick.views.camera, True, board, seen).spread_m
        variances, scale = np.diag(quick_covariance(quick, board, not lens_known)), _scale(quick.views)
    except (CalibrationError, cv2.error, np.linalg.LinAlgError):
        return None
    spread_m = quick.spread_m
    # Few views give a rough lens, so state at least the disagreement between the views.
    sigma_m = float(np.sqrt(variances[:3].sum() + spread_m**2))
    return FoundCell(
        quick.views,
        quick.poses,
        quick.fit,
        sigma_m=max(sigma_m, _LEAST_SIGMA_M),
        sigma_rad=max(float(np.sqrt(variances[3:].sum())), _LEAST_SIGMA_RAD),
        scale=scale,
        other_fits=_OTHER_MOUNT * other_m < spread_m,
    )


def _scale(views: ViewSet) -> float:
    """Estimate true over stated size of the board; 1 where the views do not tell another."""
    fit = fit_poses(pose_views(views, FOCAL_SIGMA, FREE))
    at = len(fit.solved.precision) - len(fit.factors)
    sigma = float(np.sqrt(np.linalg.inv(fit.solved.precision)[at, at]))
    return float(fit.factors[0]) if abs(fit.factors[0] - 1) > 3 * sigma else 1.0


FEWEST = 6
"""Views from which one is judged: by five, a rough lens still hides a wrong one, or makes one."""
_ORDINARY = 0.05
"""Probability of being an ordinary view below which one is asked about."""
_WAYS = {
    Reading.QUATERNION_ORDER: "with the quaternions' w first",
    Reading.INVERSE_POSES: "inverted, or with the other mounting",
    Reading.INVERSE_ROTATIONS: "with inverted rotations",
    Reading.ROTATION_VECTOR_AS_ANGLES: "with roll, pitch, yaw as rotation vectors",
    Reading.EULER_ORDER: "with angles in another order",
    Reading.ANGLES_AS_ROTATION_VECTOR: "with rotation vectors as roll, pitch, yaw",
    Reading.MIRRORED: "with mirrored images",
    Reading.MILLIMETRES: "in another unit of length",
}
"""How the poses would have to be read; other readings are named by what follows from them later."""


def odd_view(
    mount: Mount, board: BoardSpec, camera: CameraModel, lens_known: bool, seen: Sequence[BoardView]
) -> StationError | None:
    """Make the error for what cannot be about the newest view or all of them; None: they agree.

    Some 0.3 s. `camera`: without a matrix nothing is known of the lens.
    """
    if len(seen) < FEWEST:
        return None
    try:
        quick = solve_quickly(mount, camera, lens_known, board, seen)
    except (CalibrationError, cv2.error, np.linalg.LinAlgError):
        return None
    fit = quick.fit
    from calibrate.handeye.readings import explain_recording  # it loads scipy, the daemon needs none

    if (session := explain_recording(quick.poses)).reading in _WAYS:
        return StationError("poses-misread", views=len(seen), way=_WAYS[session.reading])
    if fit.full[-1] >= _ORDINARY or fit.full[:-1].mean() < 0.5:
        return None
    implied = implied_flange(mount, quick.X, quick.Y, quick.boards)[-1]
    off = difference(quick.views.base_from_flange[-1], implied)
    off_m, turn_rad = float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))
    if off_m < _LEAST_SIGMA_M and turn_rad < _LEAST_SIGMA_RAD:
        return None  # an arm's own errors are as large: nothing was told wrong
    x, y, z = (1000 * off[:3]).tolist()
    return StationError("odd-view", others=len(seen) - 1, x=x, y=y, z=z, turn=math.degrees(turn_rad))
