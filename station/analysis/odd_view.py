"""Check of views by hand against each other: a pose told wrongly, or all of them read in a wrong way."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from calibrate.errors import CalibrationError
from calibrate.geometry import difference
from calibrate.handeye.pose_fit import fit_poses, pose_views
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.readings import explain_recording
from calibrate.handeye.solution import Reading
from calibrate.views import implied_flange
from recordings.schema.messages import BoardSpec, CameraModel, Mount
from station.analysis.estimation import solve_quickly
from station.analysis.worker import CapturedView
from station.cell.errors import StationError

FEWEST = 6
"""Views from which one is judged: by five, a rough lens still hides a wrong one, or makes one."""
_FOCAL_SIGMA = 0.02
"""1σ, relative, of the focal length that so few views give."""
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
        poses = pose_views(views, _FOCAL_SIGMA, BoardTolerance.of(board).square)
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
