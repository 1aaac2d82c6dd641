"""Board pose from a calibration and one image, and the uncertainty of a tip sent to one of its corners.

Eye-in-hand: base_from_board = base_from_flange · X · camera_from_board; eye-to-hand: X · camera_from_board,
the board lying free in the fixed camera's view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from calibrate.boards.model import board_points
from calibrate.errors import BadViewsError
from calibrate.files.calibration import Calibration
from calibrate.geometry import Array, difference, inverse, perturb, transform_points
from calibrate.handeye.reprojection import bent_points
from calibrate.lens.pnp import Candidate, candidate_poses
from calibrate.quality.drift import Noise, pnp_covariance, with_found_shape
from calibrate.views import BoardView, ViewSet, observe_views
from recordings.schema.messages import BoardSpec

_SAME_PLACE_M, _SAME_PLACE_RAD = 0.01, 0.03
"""Distance within which the board counts as not moved since the calibration."""
_SAME_TILT_RAD = 0.01
"""Difference in tilt above which two results of the pose estimate are two solutions, not one found twice."""
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class BoardNow:
    base_from_board: Array
    """(4, 4)"""
    camera_from_board: Array


def locate_board(calibration: Calibration, view: BoardView, board: BoardSpec) -> BoardNow:
    """Locate the board in base from one image.

    Raises BadViewsError where the tilt is ambiguous, or where the board is still on the flange (eye-to-hand).
    """
    camera, X, E = calibration.intrinsics.model, calibration.transform.matrix, view.base_from_flange
    in_hand = calibration.mount == "eye-in-hand"
    place = np.array(calibration.board_place.matrix)
    readings = [_shaped(reading, view, calibration) for reading in candidate_poses(view, camera, board)]
    at = [E @ X @ r.camera_from_board if in_hand else X @ r.camera_from_board for r in readings]
    misses = [difference(each if in_hand else inverse(E) @ each, place) for each in at]
    near = (_SAME_PLACE_M, _SAME_PLACE_RAD)
    same = [k for k, miss in enumerate(misses) if (np.linalg.norm(miss.reshape(2, 3), axis=1) < near).all()]
    if same and not in_hand:
        raise BadViewsError("board-on-flange")
    tilts = [r.camera_from_board for r in readings if r.turn == readings[0].turn]
    if not same and any(np.linalg.norm(difference(t, tilts[0])[3:]) > _SAME_TILT_RAD for t in tilts):
        raise BadViewsError("ambiguous-tilt")
    best = same[0] if same else 0
    return BoardNow(np.asarray(at[best]), readings[best].camera_from_board)


def _shaped(reading: Candidate, view: BoardView, calibration: Calibration) -> Candidate:
    """Return the candidate pose refined with the board shape that the calibration estimated."""
    placed = replace(view, camera_from_board=reading.camera_from_board)
    views = ViewSet(calibration.mount, (placed,), calibration.intrinsics.model)
    return replace(reading, camera_from_board=with_found_shape(views, calibration).camera_from_board[0])


def found_points(calibration: Calibration, board: BoardSpec) -> Array:
    """Return the board's points (k, 3) in its frame, with the estimated shape if it is the same board."""
    points = board_points(board)
    found = calibration.quality.board
    if found is None or board != calibration.board:
        return points
    whole = BoardView(0, "", np.eye(4), points, np.zeros((len(points), 2)))
    observed = observe_views(ViewSet(calibration.mount, (whole,), calibration.intrinsics.model))
    return np.asarray(bent_points(observed, found.numbers)[0])


def offset_covariance(
    calibration: Calibration, view: BoardView, now: BoardNow, corner_m: ArrayLike, tip_m: ArrayLike
) -> Array:
    """Predict the covariance (3, 3) of tip minus corner, in `board`, m², when the arm is sent to a corner.

    First order in the errors of X, of the board's pose in this image, and of the robot at the image's pose
    (eye-in-hand) and at the corner; the robot's noise is the one that the calibration estimated.
    `corner_m` (3,) in `board`, `tip_m` (3,) in `flange`. Raises BadViewsError for a calibration that states
    no noise.
    """
    noise = Noise.of(calibration)
    corner, X, C = np.asarray(corner_m), calibration.transform.matrix, now.camera_from_board
    in_hand = calibration.mount == "eye-in-hand"
    E = view.base_from_flange if in_hand else np.eye(4)
    steps = _STEP * np.eye(6)
    robot = np.diag([noise.robot_m**2] * 3 + [noise.robot_rad**2] * 3)
    pnp = noise.corner_px**2 * pnp_covariance(view.board_points, calibration.intrinsics.model, C)
    parts = [(E @ perturb(X, steps) @ C, np.array(calibration.covariance)), (E @ X @ perturb(C, steps), pnp)]
    if in_hand:
        parts.append((perturb(E, steps) @ X @ C, robot))
    here = transform_points(E @ X @ C, corner)
    lever2 = float(np.square(tip_m).sum())
    total = (noise.robot_m**2 + noise.robot_rad**2 * lever2) * np.eye(3)  # the tip itself
    for moved, covariance in parts:
        J = (moved[:, :3, :3] @ corner + moved[:, :3, 3] - here).T / _STEP
        total = total + J @ covariance @ J.T
    R = now.base_from_board[:3, :3]
    return np.asarray(R.T @ total @ R)
