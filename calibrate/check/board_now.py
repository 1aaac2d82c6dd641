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
from calibrate.handeye.cell_state import Layout
from calibrate.handeye.reprojection import bent_points
from calibrate.lens.pnp import candidate_poses
from calibrate.views.corners import Corners
from calibrate.views.view_set import BoardView, ViewSet, observe_views
from recordings.geometry import Array, difference, inverse, skew

_SAME_PLACE_M, _SAME_PLACE_RAD = 0.01, 0.03
"""Distance within which the board counts as not moved since the calibration."""
_SAME_TILT_RAD = 0.01
"""Difference in tilt above which two results of the pose estimate are two solutions, not one found twice."""
_EXACTLY = 1e-9
"""1σ, in any unit, of what is taken as known."""


@dataclass(frozen=True, eq=False)
class BoardNow:
    base_from_board: Array
    """(4, 4)"""
    covariance: Array
    """(6, 6) of it: by the errors of X, of the corners, and of the arm at the image."""


def locate_board(calibration: Calibration, view: BoardView) -> BoardNow:
    """Locate the board in base from one image, by the installed X and the controller's flange.

    Raises BadViewsError where the tilt is ambiguous, where the board is still on the flange (eye-to-hand), or
    for a calibration that states no noise.
    """
    from calibrate.check.drift import stated_cell  # the solver: 0.2 s that no screen need wait for
    from calibrate.handeye.estimate import estimate

    in_hand, known = calibration.mount == "eye-in-hand", stated_cell(calibration)
    covariance = _EXACTLY**2 * np.eye(len(known.covariance))
    covariance[:6, :6] = calibration.covariance
    known = replace(known, covariance=covariance)
    if not in_hand:  # the board lies in base, whatever the arm does
        known = replace(known, scales=replace(known.scales, robot=np.full(2, _EXACTLY)))
    flange = view.base_from_flange if in_hand else np.eye(4)
    readings = candidate_poses(view, known.mean.camera, calibration.board)
    prior, at = known.prior(camera_may_have_moved=False), []
    for reading in readings:
        seen = replace(view, base_from_flange=flange, camera_from_board=reading.camera_from_board)
        views = ViewSet(calibration.mount, (seen,), known.mean.camera)
        found = estimate(known.observe(views), known.start(views), prior, known.scales, fit="nothing")
        rows = Layout.of(found.state).Y
        at.append(BoardNow(found.state.Y, found.covariance[rows, rows]))
    place, E = np.array(calibration.board_place.matrix), view.base_from_flange
    misses = [difference(b.base_from_board if in_hand else inverse(E) @ b.base_from_board, place) for b in at]
    near = (_SAME_PLACE_M, _SAME_PLACE_RAD)
    same = [k for k, miss in enumerate(misses) if (np.linalg.norm(miss.reshape(2, 3), axis=1) < near).all()]
    if same and not in_hand:
        raise BadViewsError("board-on-flange")
    tilts = [b.base_from_board for b, r in zip(at, readings, strict=True) if r.turn == readings[0].turn]
    if not same and any(np.linalg.norm(difference(t, tilts[0])[3:]) > _SAME_TILT_RAD for t in tilts):
        raise BadViewsError("ambiguous-tilt")
    return at[same[0] if same else 0]


def found_points(calibration: Calibration) -> Array:
    """Return the board's points (k, 3) in its frame, with the estimated shape."""
    points, found = board_points(calibration.board), calibration.quality.board
    if found is None:
        return points
    whole = BoardView(0, "", np.eye(4), Corners(points, np.zeros((len(points), 2))))
    observed = observe_views(ViewSet(calibration.mount, (whole,), calibration.intrinsics.model))
    return np.asarray(bent_points(observed, found.numbers)[0])


def offset_covariance(
    calibration: Calibration, now: BoardNow, corner_m: ArrayLike, tip_m: ArrayLike
) -> Array:
    """Predict the covariance (3, 3) of tip minus corner, in `board`, m², when the arm is sent to a corner.

    First order in the errors of the board's pose and of the robot at the corner, whose noise is the one that
    the calibration estimated. `corner_m` (3,) in `board`, `tip_m` (3,) in `flange`. Raises as `locate_board`.
    """
    from calibrate.check.drift import stated_cell

    robot_m, robot_rad = stated_cell(calibration).scales.robot
    R = now.base_from_board[:3, :3]
    J = np.concatenate([np.eye(3), -skew(R @ np.asarray(corner_m))], axis=1)
    tip = robot_m**2 + robot_rad**2 * float(np.square(tip_m).sum())
    return np.asarray(R.T @ (J @ now.covariance @ J.T + tip * np.eye(3)) @ R)
