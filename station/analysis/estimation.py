"""Running estimate: a quick X with its uncertainty after each pose, never used as the result."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from calibrate.arms.classes import ArmClass, arm_class
from calibrate.boards.detect import detect
from calibrate.boards.model import board_points
from calibrate.errors import CalibrationError
from calibrate.handeye.information import (
    covariance_of,
    predicted_error_m,
    prior_information,
    view_information,
    with_more_views_m,
)
from calibrate.handeye.metrics import median_distance_m
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.placed_point import PointPrediction
from calibrate.handeye.pose_fit import PoseFit, PoseViews, fit_poses, pose_views
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.unlearned_arm import UnlearnedArm
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.pipeline.gates import ADVICE, STATION_ERROR_M, GateLimits
from calibrate.views.view_set import BoardView, ViewSet
from recordings.errors import RecordingError
from recordings.files import MAIN_CAMERA
from recordings.geometry import Array
from recordings.images import viewable
from recordings.reader import open_recording
from recordings.schema.messages import BoardSpec, CameraModel, Mount, RobotIdentity
from station.cell.config import RobotConfig, StationConfig, matrix4
from station.cell.layout import board_place
from station.cell.status import WORTH_TEN_VIEWS, EstimateStatus
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
        error = quick_error(quick, config.board, not lens_is_known, class_of(config.robot, seen))
    except (CalibrationError, cv2.error, np.linalg.LinAlgError):
        return blank
    joints_known = all(view.joints_rad is not None for view in seen)
    return msgspec.structs.replace(
        blank,
        camera_pose=matrix4(quick.X),
        board_pose=matrix4(quick.Y),
        predicted_error_mm=_mm(error.error_m),
        floor_mm=_mm(error.floor_m),
        with_more_views_mm=_mm(error.with_more_views_m),
        working_distance_m=round(error.distance_m, 4),
        enough=error.enough(config.capture.goal_m) and gates_would_pass(quick, error, joints_known),
    )


@dataclass(frozen=True)
class QuickError:
    """The error of a placed point by the views so far, metres."""

    error_m: float
    from_x_m: float
    """Part by X: what views lower."""
    floor_m: float
    """Part by the arm, its errors and what it does differently each time: what no view lowers."""
    with_more_views_m: float
    """What ten more views like these would leave of `error_m`."""
    distance_m: float
    """Of the point from the camera."""

    def enough(self, goal_m: float) -> bool:
        """Tell whether the goal is reached, or is beyond the arm, and more views hardly lower the error."""
        if self.error_m <= goal_m:
            return True
        return self.floor_m > goal_m and self.with_more_views_m > (1.0 - WORTH_TEN_VIEWS) * self.error_m


def class_of(robot: RobotConfig | RobotIdentity, seen: Sequence[BoardView]) -> ArmClass:
    """Look up the class of an arm, as a solve of these views would."""
    joints = seen[0].joints_rad if seen else None
    return arm_class(robot.model, robot.arm_class, None if joints is None else len(joints))


def quick_error(
    quick: QuickFit, board: BoardSpec, free_lens: bool, of_class: ArmClass | None = None
) -> QuickError:
    """Predict the error of a placed point by the quick fit and the arm's class.

    of_class: class of the arm; None: its links have no errors. LinAlgError where X and Y put the board out of
    sight.
    """
    distance_m = median_distance_m(quick.views.camera_from_board)
    point = quick_point(quick, distance_m)
    information, prior = _quick_information(quick, board, free_lens)
    known_m = predicted_error_m(information, prior, point)
    more_m = with_more_views_m(information, prior, point, float(quick.fit.full.sum()))
    arm_m = 0.0 if of_class is None else quick_arm_part_m(quick, board, free_lens, of_class, distance_m)
    return QuickError(
        error_m=float(np.hypot(known_m, arm_m)),
        from_x_m=float(np.sqrt(max(known_m**2 - point.floor_m**2, 0.0))),
        floor_m=float(np.hypot(point.floor_m, arm_m)),
        with_more_views_m=float(np.hypot(more_m, arm_m)),
        distance_m=distance_m,
    )


def quick_arm_part_m(
    quick: QuickFit, board: BoardSpec, free_lens: bool, of_class: ArmClass, distance_m: float
) -> float:
    """Compute the part of a placed point's error by errors of the arm's links, metres (`unlearned_arm`).

    0 where no typical arm reaches all views. LinAlgError where X and Y put the board out of sight.
    """
    arm = UnlearnedArm.of(
        quick.views.mount,
        quick.views.camera,
        quick.views.base_from_flange,
        quick.X,
        quick.Y,
        board_points(board),
        quick.noise,
        BoardTolerance.of(board),
        not free_lens,
        of_class,
        distance_m,
    )
    return 0.0 if arm is None else arm.part_m(quick.fit.full)


def quick_point(quick: QuickFit, distance_m: float) -> PointPrediction:
    """Predict for a point so far from the camera, at the postures of the views so far."""
    views = quick.views
    return PointPrediction.of(views.mount, quick.X, views.base_from_flange, distance_m, quick.noise)


_MOST = 0.8
"""Least share of the views that agree; of fewer the board, or the camera, may have been moved."""


def gates_would_pass(quick: QuickFit, error: QuickError, joints_known: bool) -> bool:
    """Judge what solving will ask and the quick fit tells already.

    Where many views contradict the others the session is in doubt: the board may have been moved.
    joints_known: the arm's own errors can be learned; else their size is assumed, and nothing fails by it
    alone.
    """
    from calibrate.handeye.estimate import REJECTED  # it loads scipy, the daemon needs none

    limits = GateLimits()
    used = quick.fit.solved.chances[:, :2].sum(axis=1) > REJECTED
    judged_m = error.error_m if joints_known else error.from_x_m
    return bool(
        used.sum() >= (limits.views or ADVICE["views"])
        and judged_m <= (limits.predicted_error_m or STATION_ERROR_M)
        and quick.fit.full.mean() >= _MOST
    )


def _mm(length_m: float) -> float:
    return round(1000 * length_m, 3)


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

    @property
    def spread_m(self) -> float:
        """Rms distance of the board's positions, by single views, from their mean."""
        flange = self.views.base_from_flange
        places = board_place(self.views.mount, flange, self.X, self.boards)[:, :3, 3]
        return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))


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
    return covariance_of(*_quick_information(quick, board, free_lens))[:6, :6]


def _quick_information(quick: QuickFit, board: BoardSpec, free_lens: bool) -> tuple[Array, Array]:
    """Sum the information of the views, and make the prior."""
    views, points = quick.views, board_points(board)
    flange = views.base_from_flange
    each = view_information(views.mount, views.camera, flange, quick.X, quick.Y, points, quick.noise)
    prior = prior_information(views.camera, not free_lens, BoardTolerance.of(board))
    # A view that contradicts the others tells nothing.
    information = np.tensordot(quick.fit.full, each, 1)
    if not np.isfinite(information).all():
        raise np.linalg.LinAlgError("the board is out of sight")
    return information, prior


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
                joints = None if view.joints_rad is None else np.array(view.joints_rad)
                seen.append(BoardView(view.index, view.name, flange, found.corners, joints))
    return seen
