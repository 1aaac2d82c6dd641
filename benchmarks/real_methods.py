"""Ours and the peers behind one shape: training views in; lens, X and board place out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import vision_calibration
from vision_calibration import models as rs

from calibrate.errors import CalibrationError
from calibrate.handeye.axxb.peer_methods import HAND_EYE, ROBOT_WORLD, opencv_hand_eye, opencv_robot_world
from calibrate.handeye.reprojection import bent_points
from calibrate.handeye.solution import Solution, SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.pipeline.job import single_threaded_opencv
from calibrate.views.view_set import BoardView, ViewSet, observe_views
from recordings.geometry import Array, inverse, pose_from_quaternion, quaternion_from_matrix
from recordings.schema.messages import BoardSpec, CameraModel

FAILURES = (CalibrationError, cv2.error, np.linalg.LinAlgError, ValueError, RuntimeError)
CALIBRATION_RS = "calibration-rs"


def _as_described(points: Array) -> Array:
    return points


@dataclass(frozen=True, eq=False)
class Answer:
    """Answer that a method learns from the training views."""

    X: Array
    """(4, 4) flange_from_camera or base_from_camera"""
    centre: Array
    """(3,) board centre at its trained place, in base (eye-in-hand) or flange"""
    camera: CameraModel
    shape: Callable[[Array], Array] = _as_described
    """Described board points (k, 3) to those that the method believes in."""
    covariance: Array | None = None
    """(6, 6) claimed, of `geometry.perturb`'s delta"""
    weights: dict[int, float] = field(default_factory=dict)
    """View index to 0 (rejected) … 1 (full)"""


Method = Callable[[ViewSet, BoardSpec], dict[str, Answer]]


def ours(views: ViewSet, board: BoardSpec) -> Answer:
    """The way that `calibrate solve` takes after detection. THE place to change when that way changes."""
    free = views.camera.matrix is None
    with single_threaded_opencv():
        if free:
            views = replace(views, camera=calibrate_intrinsics(views).camera)
        views = solve_pnp(views, board)
        options = SolveOptions(intrinsics_from_same_pictures=free, holdout=False, folds=False)
        solution = solve_views(views, options)
    Y = solution.fit.board_place.matrix
    shape = _shape(views, solution)
    return Answer(
        X=solution.matrix,
        centre=Y[:3, :3] @ shape(board_centre(views)[None])[0] + Y[:3, 3],
        camera=solution.fit.camera,
        shape=shape,
        covariance=solution.covariance,
        weights=solution.evidence.weights,
    )


def _shape(views: ViewSet, solution: Solution) -> Callable[[Array], Array]:
    """Points of the board as stated (k, 3) to where the solution has them."""
    found = solution.fit.board
    if found is None:
        return _as_described
    observed = observe_views(views)
    numbers = np.array([found.scale, found.anisotropy, *found.bend_m])

    def bent(points: Array) -> Array:
        return np.asarray(bent_points(replace(observed, points=points[None]), numbers)[0])

    return bent


def opencv(views: ViewSet, board: BoardSpec) -> dict[str, Answer]:
    """OpenCV's seven, with `calibrateCamera`'s lens, and with the given one where there is one."""
    lenses = {"": opencv_lens(views)}
    if views.camera.matrix is not None:
        lenses[" (lens given)"] = views.camera
    answers = {}
    for label, camera in lenses.items():
        seen = solve_pnp(replace(views, camera=camera), board)
        F, C = seen.base_from_flange, seen.camera_from_board
        H = F if views.mount == "eye-in-hand" else inverse(F)
        for name, number in (HAND_EYE | ROBOT_WORLD).items():
            solve = opencv_hand_eye if name in HAND_EYE else opencv_robot_world
            try:
                X = solve(H, C, number)
            except FAILURES:
                continue
            if np.isfinite(X).all():
                centres = (H @ X @ C) @ np.append(board_centre(views), 1.0)
                answers[name + label] = Answer(X, centres[:, :3].mean(axis=0), camera)
    return answers


def opencv_lens(views: ViewSet) -> CameraModel:
    """`cv2.calibrateCamera` with its own defaults."""
    unknown: Array = None  # type: ignore[assignment]
    _, K, D, _, _ = cv2.calibrateCamera(
        [view.corners.points.astype(np.float32) for view in views],
        [view.corners.pixels.astype(np.float32) for view in views],
        (views.camera.width, views.camera.height),
        unknown,
        unknown,
    )
    return _camera(views, np.asarray(K, dtype=float), np.asarray(D, dtype=float).ravel()[:5])


def calibration_rs(views: ViewSet) -> dict[str, Answer]:
    """Bundle adjustment of lens, X, board place and robot poses by `vision-calibration`, its own defaults."""
    in_hand = views.mount == "eye-in-hand"
    data = rs.SingleCamHandeyeDataset([_observation(view) for view in views])
    config = rs.SingleCamHandeyeCalibrationConfig(
        handeye_init=rs.HandeyeInitConfig(handeye_mode="EyeInHand" if in_hand else "EyeToHand")
    )
    result = vision_calibration.run_single_cam_handeye(data, config)
    K, D = result.camera.intrinsics, result.camera.distortion
    matrix = np.array([[K.fx, K.skew, K.cx], [0.0, K.fy, K.cy], [0.0, 0.0, 1.0]])
    camera = _camera(views, matrix, np.array([D.k1, D.k2, D.p1, D.p2, D.k3]))
    found, place = (
        (result.gripper_se3_camera, result.base_se3_target)
        if in_hand
        else (result.camera_se3_base, result.gripper_se3_target)
    )
    if found is None or place is None:
        raise ValueError("calibration-rs returned no pose")
    X, Y = (np.asarray(pose_from_quaternion(p.translation_xyz, p.rotation_xyzw)) for p in (found, place))
    centre = Y[:3, :3] @ board_centre(views) + Y[:3, 3]
    return {CALIBRATION_RS: Answer(X if in_hand else inverse(X), centre, camera)}


def _observation(view: BoardView) -> rs.SingleCamHandeyeView:
    F = view.base_from_flange
    pose = rs.Pose(tuple(quaternion_from_matrix(F[:3, :3]).tolist()), tuple(F[:3, 3].tolist()))
    points = [tuple(point) for point in view.corners.points.tolist()]
    pixels = [tuple(pixel) for pixel in view.corners.pixels.tolist()]
    return rs.SingleCamHandeyeView(rs.Observation(points, pixels), pose)


def _camera(views: ViewSet, K: Array, D: Array) -> CameraModel:
    rows = tuple(tuple(float(v) for v in row) for row in K)
    distortion = tuple(float(v) for v in D)
    return CameraModel(views.camera.width, views.camera.height, rows, distortion)  # type: ignore[arg-type]


def board_centre(views: ViewSet) -> Array:
    """(3,) middle of the board's points in `board`."""
    points = np.concatenate([view.corners.points for view in views])
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def predicted_centre(views: ViewSet, place: int, answer: Answer) -> Array:
    """(3,) where X, the robot's pose and the view's own PnP put the board centre."""
    view, centre = views.views[place], answer.shape(board_centre(views)[None])[0]
    F = view.base_from_flange if views.mount == "eye-in-hand" else inverse(view.base_from_flange)
    return np.asarray((F @ answer.X @ view_pnp(view, answer) @ np.append(centre, 1.0))[:3])


def view_pnp(view: BoardView, answer: Answer) -> Array:
    """camera_from_board of one view by its own corners: the better of the plane's two poses, refined."""
    points = answer.shape(view.corners.points)
    K, D = np.array(answer.camera.matrix), np.array(answer.camera.distortion)
    flat = np.ascontiguousarray(points * [1.0, 1.0, 0.0])
    _, rotations, shifts, _ = cv2.solvePnPGeneric(flat, view.corners.pixels, K, D, flags=cv2.SOLVEPNP_IPPE)
    best, best_square = np.eye(4), np.inf
    for first_r, first_t in zip(rotations, shifts, strict=True):
        r, t = cv2.solvePnPRefineLM(points, view.corners.pixels, K, D, first_r.copy(), first_t.copy())
        shown, _ = cv2.projectPoints(points, r, t, K, D)
        square = float(np.square(shown[:, 0] - view.corners.pixels).sum())
        if square < best_square:
            best_square = square
            best[:3, :3], best[:3, 3] = cv2.Rodrigues(r)[0], t.ravel()
    if not np.isfinite(best_square):
        raise ValueError("no board pose")
    return best
