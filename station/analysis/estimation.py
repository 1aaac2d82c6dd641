"""Running estimate: a quick X with its uncertainty after each pose, never used as the result."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from calibrate.boards.detect import detect
from calibrate.boards.model import board_points
from calibrate.errors import CalibrationError
from calibrate.handeye.information import covariance_of, prior_information, view_information
from calibrate.handeye.metrics import median_distance_m, point_error_m
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.pose_fit import PoseFit, PoseViews, fit_poses, pose_views
from calibrate.handeye.priors import BoardTolerance
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.views.view_set import BoardView, ViewSet
from recordings.errors import RecordingError
from recordings.files import MAIN_CAMERA
from recordings.geometry import Array
from recordings.images import viewable
from recordings.reader import open_recording
from recordings.schema.messages import BoardSpec, CameraModel, Mount
from station.cell.config import StationConfig, matrix4
from station.cell.status import EstimateStatus
from station.plan.visibility import count_in_parts

FEWEST_FOR_CELL, FEWEST_FOR_ESTIMATE = 3, 4
FEWEST_FOR_LENS = 6
"""Views from which a lens that is known roughly is estimated; from three on where nothing is known of it."""
COVERAGE_ROWS, COVERAGE_COLUMNS = 4, 6
FOCAL_SIGMA = 0.02
"""1σ, relative, of the focal length that so few views give."""


def running_estimate(
    config: StationConfig, camera: CameraModel, lens_is_known: bool, seen: Sequence[BoardView]
) -> EstimateStatus:
    """Estimate from the views so far; with too few views or too little motion without numbers.

    `camera`: without a matrix nothing is known of its lens.
    """
    shown = [
        count_in_parts(camera, view.corners.pixels, COVERAGE_ROWS, COVERAGE_COLUMNS) > 0 for view in seen
    ]
    blank = EstimateStatus(
        len(seen),
        image_views=tuple(tuple(int(n) for n in row) for row in np.sum(shown, axis=0)),
    )
    if len(seen) < FEWEST_FOR_ESTIMATE:
        return blank
    try:
        quick = solve_quickly(config.mount, camera, lens_is_known, config.board, seen)
        covariance = quick_covariance(quick, config.board, not lens_is_known)
    except (CalibrationError, cv2.error, np.linalg.LinAlgError):
        return blank
    distance_m = median_distance_m(quick.views.camera_from_board)
    error_m = point_error_m(quick.X, covariance, distance_m)
    return msgspec.structs.replace(
        blank,
        camera_pose=matrix4(quick.X),
        board_pose=matrix4(quick.Y),
        predicted_error_mm=round(1000 * error_m, 3),
        working_distance_m=round(distance_m, 4),
        enough=error_m <= config.capture.goal_m,
    )


@dataclass(frozen=True, eq=False)
class QuickFit:
    """Fit of the views as poses, in some 50 ms."""

    views: ViewSet
    """With the lens that was used, and the board's pose in each image."""
    poses: PoseViews
    fit: PoseFit

    @property
    def X(self) -> Array:
        """flange_from_camera (eye-in-hand) or base_from_camera, (4, 4)"""
        return np.asarray(self.fit.X[0])

    @property
    def Y(self) -> Array:
        """base_from_board (eye-in-hand) or flange_from_board, (4, 4)"""
        return np.asarray(self.fit.Y[0])

    @property
    def boards(self) -> Array:
        """camera_from_board (n, 4, 4), with focal length and board size as fitted."""
        return self.poses.boards.at(self.fit.factors)

    @property
    def noise(self) -> MeasurementNoise:
        """By how far the views agree: a coarse arm, or poor light, is not taken for a usual one."""
        return MeasurementNoise(self.poses.corner_px, *self.fit.solved.scales.robot.tolist())


def solve_quickly(
    mount: Mount, camera: CameraModel, lens_is_known: bool, board: BoardSpec, seen: Sequence[BoardView]
) -> QuickFit:
    """Fit the views quickly. CalibrationError, cv2.error or LinAlgError when they are degenerate."""
    views = as_views(mount, camera, board, seen)
    if camera.matrix is None:
        views = replace(views, camera=calibrate_intrinsics(views).camera)
    elif not lens_is_known and len(views) >= FEWEST_FOR_LENS:
        with contextlib.suppress(CalibrationError):  # else keep the rough lens
            views = replace(views, camera=calibrate_intrinsics(views).camera)
    views = solve_pnp(views, board)
    poses = pose_views(views, FOCAL_SIGMA, BoardTolerance.of(board).square)
    return QuickFit(views, poses, fit_poses(poses))


def as_views(mount: Mount, camera: CameraModel, board: BoardSpec, seen: Sequence[BoardView]) -> ViewSet:
    """Make the solver's views from captured ones.

    The sizes of a new cell's board may have been corrected since: the corners are placed on `board` as it is.
    """
    points = board_points(board)
    found = (replace(view, corners=view.corners.placed(points)) for view in seen)
    return ViewSet(mount, tuple(found), camera)


def quick_covariance(quick: QuickFit, board: BoardSpec, free_lens: bool) -> Array:
    """Predict the covariance (6, 6) of X. LinAlgError where X and Y put the board out of sight."""
    views, points = quick.views, board_points(board)
    flange = views.base_from_flange
    each = view_information(views.mount, views.camera, flange, quick.X, quick.Y, points, quick.noise)
    prior = prior_information(views.camera, not free_lens, BoardTolerance.of(board))
    # A view that contradicts the others tells nothing.
    covariance = covariance_of(np.tensordot(quick.fit.full, each, 1), prior)[:6, :6]
    if not np.isfinite(covariance).all():
        raise np.linalg.LinAlgError("the board is out of sight")
    return covariance


def seen_before(path: Path, board: BoardSpec) -> list[BoardView]:
    """Detect the board in a recording; return the views that show it, skipping undecodable images.

    RecordingError for a recording that cannot be read.
    """
    recording, seen = open_recording(path), list[BoardView]()
    camera = recording.info.camera_identity.name or MAIN_CAMERA
    for view in recording.views():
        with contextlib.suppress(RecordingError):
            image = recording.image(view)
            found = detect(viewable(image.pixels, image.pixel_format), board, camera=camera)
            if found.found:
                flange = np.array(view.base_from_flange)
                seen.append(BoardView(view.index, view.name, flange, found.corners))
    return seen
