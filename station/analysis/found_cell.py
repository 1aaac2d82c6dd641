"""The cell by views so far: camera and board pose, a rough lens, and what is probably wrong.

Which answer of a new cell, which told pose, or which way of reading all poses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import cv2
import numpy as np

from calibrate.errors import CalibrationError
from calibrate.geometry import Array, difference, inverse
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.pose_fit import fit_poses, pose_views
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.readings import explain_recording
from calibrate.handeye.solution import Reading
from calibrate.views import ViewSet, implied_flange
from recordings.schema.messages import BoardSpec, CameraModel, Mount
from station.analysis.estimation import (
    FEWEST_FOR_CELL,
    FOCAL_SIGMA,
    measured_noise,
    quick_covariance,
    solve_quickly,
)
from station.analysis.worker import CapturedView
from station.cell.errors import StationError
from station.cell.layout import board_place

GOOD_M, GOOD_RAD = 0.010, math.radians(2.0)
"""1σ of the camera's pose below which the views are enough for planning."""
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 0.003, 0.01
"""Smallest 1σ that is stated, because the true arm differs from its nominal table."""
_MOVED_M = 0.006
"""Spread of the board's position over the views above which it, or the camera, was moved."""
_WRONG_SCALE = 0.03
"""Relative deviation of the squares from their stated size above which a warning is given."""
_SCALE_SIGMA, _TRAVEL_M = 0.5, 0.001
"""Prior 1σ of the scale; 1σ of the arm's travel against the camera's."""
_OTHER_MOUNT = 3.0
"""Ratio of the fits from which the other mounting is taken to be the right one."""


@dataclass(frozen=True, eq=False)
class FoundCell:
    """Camera, board and mounting estimated from the views."""

    views: ViewSet
    """With the lens that was used, and the board's pose in each image."""
    X: Array
    """flange_from_camera (eye-in-hand) or base_from_camera, (4, 4)"""
    Y: Array
    """base_from_board (eye-in-hand) or flange_from_board, (4, 4)"""
    noise: MeasurementNoise
    """By the views."""
    sigma_m: float
    sigma_rad: float
    spread_m: float
    """Rms distance of the board's positions, by single views, from their mean."""
    scale: float
    """Size of the squares, measured by the arm's motion, over the stated size."""
    other_fits: bool
    """True when the other mounting explains the views far better."""

    @property
    def good(self) -> bool:
        return self.sigma_m <= GOOD_M and self.sigma_rad <= GOOD_RAD and not self.cause

    @property
    def cause(self) -> Literal["", "other-mounting", "square-size", "moved"]:
        """Code of what is probably wrong; empty: nothing."""
        if self.other_fits:
            return "other-mounting"
        if abs(self.scale - 1) > _WRONG_SCALE:
            return "square-size"
        return "moved" if self.spread_m > _MOVED_M else ""

    @property
    def warning(self) -> str:
        """Say what is probably wrong, and the remedy; empty: nothing."""
        if self.cause == "other-mounting":
            return "These views fit the other mounting: camera on the flange, or beside the arm."
        if self.cause == "square-size":
            return (
                f"By the arm's travel the squares are {self.scale:.2f} times as large as stated. "
                "Measure one and correct the board: the views stay."
            )
        if self.cause == "moved":
            return (
                f"The board or the camera moved: the views see it {1000 * self.spread_m:.0f} mm apart. "
                "Fix both, take back the views and begin again."
            )
        return ""


def find_cell(
    mount: Mount, board: BoardSpec, camera: CameraModel, lens_known: bool, seen: Sequence[CapturedView]
) -> FoundCell | None:
    """Estimate camera and board pose, and the lens where it is not known, in about 0.1 s.

    `camera`: without a matrix nothing is known of the lens. None: the views are not enough.
    """
    if len(seen) < FEWEST_FOR_CELL:
        return None
    try:
        views, X, Y = solve_quickly(mount, camera, lens_known, board, seen)
        other: Mount = "eye-to-hand" if mount == "eye-in-hand" else "eye-in-hand"
        other_views, other_X, _ = solve_quickly(other, views.camera, True, board, seen)
        noise = measured_noise(views, board)
        variances = np.diag(quick_covariance(views, board, X, Y, not lens_known, noise))
    except (CalibrationError, cv2.error, np.linalg.LinAlgError):
        return None
    spread_m, other_m = _spread_m(views, X), _spread_m(other_views, other_X)
    # Few views give a rough lens, so state at least the disagreement between the views.
    sigma_m = float(np.sqrt(variances[:3].sum() + spread_m**2))
    return FoundCell(
        views=views,
        X=X,
        Y=Y,
        noise=noise,
        sigma_m=max(sigma_m, _LEAST_SIGMA_M),
        sigma_rad=max(float(np.sqrt(variances[3:].sum())), _LEAST_SIGMA_RAD),
        spread_m=spread_m,
        scale=_scale(views, X),
        other_fits=_OTHER_MOUNT * other_m < spread_m,
    )


def _spread_m(views: ViewSet, X: Array) -> float:
    """Compute the rms distance of the board's positions, by single views, from their mean."""
    places = board_place(views.mount, views.base_from_flange, X, views.camera_from_board)[:, :3, 3]
    return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _scale(views: ViewSet, X: Array) -> float:
    """Estimate the factor on the board's size at which camera and arm move by equal distances.

    AX = XB by translations (Shiu & Ahmad 1989) with t_B times an unknown factor: linear in it and in t_X.
    Views that only rotate about one point do not determine it, hence the prior 1 ± `_SCALE_SIGMA`.
    """
    flange = views.base_from_flange
    gripper = flange if views.mount == "eye-in-hand" else inverse(flange)
    left, right = (
        [np.array([[0.0, 0.0, 0.0, _TRAVEL_M / _SCALE_SIGMA]])],
        [np.array([_TRAVEL_M / _SCALE_SIGMA])],
    )
    for i, j in combinations(range(len(gripper)), 2):
        A = inverse(gripper[j]) @ gripper[i]
        B = views.camera_from_board[j] @ inverse(views.camera_from_board[i])
        left.append(np.hstack([A[:3, :3] - np.eye(3), -(X[:3, :3] @ B[:3, 3])[:, None]]))
        right.append(-A[:3, 3])
    rows = np.vstack(left)
    solution = np.linalg.lstsq(rows, np.concatenate(right), rcond=None)[0]
    sigma = _TRAVEL_M * float(np.sqrt(np.linalg.inv(rows.T @ rows)[3, 3]))
    left_m = rows[1:] @ solution - np.concatenate(right[1:])
    explained = float(np.sqrt((left_m**2).mean())) <= 2 * _TRAVEL_M
    return float(solution[3]) if explained and abs(solution[3] - 1) > 3 * sigma else 1.0


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
    mount: Mount, board: BoardSpec, camera: CameraModel, lens_known: bool, seen: Sequence[CapturedView]
) -> StationError | None:
    """Make the error for what cannot be about the newest view or all of them; None: they agree.

    Some 0.3 s. `camera`: without a matrix nothing is known of the lens.
    """
    if len(seen) < FEWEST:
        return None
    try:
        views, _, _ = solve_quickly(mount, camera, lens_known, board, seen)
        poses = pose_views(views, FOCAL_SIGMA, BoardTolerance.of(board).square)
        fit = fit_poses(poses)
    except (CalibrationError, cv2.error, np.linalg.LinAlgError):
        return None
    if (session := explain_recording(poses)).reading in _WAYS:
        return StationError("poses-misread", views=len(seen), way=_WAYS[session.reading])
    if fit.full[-1] >= _ORDINARY or fit.full[:-1].mean() < 0.5:
        return None
    implied = implied_flange(mount, fit.X[0], fit.Y[0], poses.boards.at(fit.factors))[-1]
    off = difference(views.base_from_flange[-1], implied)
    x, y, z = 1000 * off[:3]
    return StationError(
        "odd-view", others=len(seen) - 1, x=x, y=y, z=z, turn=math.degrees(float(np.linalg.norm(off[3:])))
    )
