"""Layout of a cell by its configuration: camera and board pose with uncertainty, solids and obstacles."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from calibrate.arms.classes import ArmClass, arm_class
from calibrate.arms.kinematics import MODELS, RobotModel, forward, with_near_axes
from calibrate.boards.model import board_points
from calibrate.views.projection import camera_matrix
from calibrate.views.view_set import board_in_camera, implied_flange
from recordings.geometry import (
    Array,
    inverse,
    pose_from_quaternion,
    quaternion_from_matrix,
    transform_points,
)
from recordings.schema.messages import BoardSpec, CameraModel, Mount
from station.cell.collision import CellGeometry, plate
from station.cell.config import (
    UNKNOWN_ARM,
    Capsule,
    PoseGuess,
    RobotConfig,
    StationConfig,
    Vector3,
    matrix4,
    vector3,
    vector6,
)
from station.cell.errors import ConfigError, LimitError
from station.cell.pose_plan import Plan, PlannedPose

_CAMERA_BODY_M, _CAMERA_RADIUS_M = 0.05, 0.035
_DOUBT = 3.0
"""Sigmas of its pose by which a body with a rough pose is thickened for collision checks."""
_MOST_DOUBT_M = 0.03
"""Largest thickening; a thicker camera would collide with the wrist in every posture."""


@dataclass(frozen=True, eq=False)
class CellLayout:
    """Initial camera and board pose with 1σ, lens, board and geometry of a cell, as planning needs them."""

    mount: Mount
    camera: CameraModel
    board: BoardSpec
    X: Array
    """flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand), (4, 4)"""
    Y: Array
    """base_from_board (eye-in-hand) or flange_from_board (eye-to-hand), (4, 4)"""
    geometry: CellGeometry
    x_sigma: tuple[float, float] = (0.0, 0.0)
    """1σ of X per axis: metres, radians."""
    y_sigma: tuple[float, float] = (0.0, 0.0)
    working_distance_m: float = 0.5
    of_class: ArmClass | None = None
    """The arm's class, by which its own error is looked up; None: its links have no errors."""

    def camera_from_board(self, base_from_flange: Array) -> Array:
        """Compute camera_from_board (..., 4, 4) for flange poses (..., 4, 4)."""
        return board_in_camera(self.mount, base_from_flange, self.X, self.Y)

    def base_from_flange(self, camera_from_board: Array) -> Array:
        """Compute the flange poses (..., 4, 4) for views camera_from_board (..., 4, 4)."""
        return implied_flange(self.mount, self.X, self.Y, camera_from_board)

    def seen(self, base_from_flange: Array, points: Array) -> Array:
        """Transform board points (k, 3) to `camera` for n flange poses: (n, k, 3)."""
        return transform_points(self.camera_from_board(base_from_flange), points)


def board_place(mount: Mount, base_from_flange: Array, X: Array, camera_from_board: Array) -> Array:
    """Compute the board's constant pose: base_from_board (eye-in-hand) or flange_from_board."""
    if mount == "eye-in-hand":
        return np.asarray(base_from_flange @ X @ camera_from_board)
    return np.asarray(inverse(base_from_flange) @ X @ camera_from_board)


def frustum(camera: CameraModel, base_from_camera: Array, far_m: float) -> Array:
    """Compute optical centre and image corners at distance `far_m`, in order, (5, 3) in `base`."""
    w, h = camera.width, camera.height
    corners = np.array([(0, 0, 1), (w, 0, 1), (w, h, 1), (0, h, 1)]) @ np.linalg.inv(camera_matrix(camera)).T
    return transform_points(base_from_camera, np.vstack([np.zeros(3), far_m * corners]))


def pose_at(model: RobotModel, name: str, joints_rad: ArrayLike) -> PlannedPose:
    """Make a plan's pose from joints (6,), with the expected flange pose."""
    joints = np.asarray(joints_rad, dtype=float)
    return PlannedPose(name, vector6(joints), matrix4(forward(model, joints)))


def board_extent(board: BoardSpec) -> tuple[Array, Array]:
    """Return low and high corner (2,) of the printed area: one square beyond the outermost points."""
    points = board_points(board)[:, :2]
    return points.min(axis=0) - board.square_m, points.max(axis=0) + board.square_m


def printed_corners(board: BoardSpec) -> Array:
    """Return the four corners of the printed area in order, (4, 3) in `board`."""
    (x0, y0), (x1, y1) = board_extent(board)
    return np.array([(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)])


def known_places(config: StationConfig) -> tuple[CameraModel, PoseGuess, PoseGuess]:
    """Return lens, initial camera pose and initial board pose. ConfigError names what is missing."""
    camera, mount_guess, place_guess = config.camera.model, config.camera_guess, config.board_guess
    if camera is None or camera.matrix is None:
        raise ConfigError("no-lens")
    if mount_guess is None or place_guess is None:
        missing = "camera_guess" if mount_guess is None else "board_guess"
        raise ConfigError("no-guess", missing=missing)
    return camera, mount_guess, place_guess


def layout_of(config: StationConfig) -> CellLayout:
    """Make the layout of a cell from its configuration. ConfigError names what is missing."""
    camera, mount_guess, place_guess = known_places(config)
    return CellLayout(
        config.mount,
        camera,
        config.board,
        X=guess_matrix(mount_guess),
        Y=guess_matrix(place_guess),
        geometry=cell_geometry(config),
        x_sigma=(mount_guess.sigma_m, mount_guess.sigma_rad),
        y_sigma=(place_guess.sigma_m, place_guess.sigma_rad),
        working_distance_m=config.working_distance_m,
        of_class=arm_class(config.robot.model, config.robot.arm_class),
    )


def guess_matrix(guess: PoseGuess) -> Array:
    """Convert a configured pose to a matrix (4, 4)."""
    return pose_from_quaternion(guess.translation_m, guess.rotation_xyzw)


def guess_from(matrix: Array, sigma_m: float, sigma_rad: float) -> PoseGuess:
    """Convert a transform (4, 4) to a configured pose."""
    quaternion = quaternion_from_matrix(matrix[:3, :3])
    x, y, z, w = (float(value) for value in quaternion)
    return PoseGuess(vector3(matrix[:3, 3]), (x, y, z, w), sigma_m, sigma_rad)


def arm_model(robot: RobotConfig) -> RobotModel:
    """Return the configured arm, with its factory calibration if given.

    ConfigError: `robot-model-not-told`, `unknown-robot-model`.
    """
    if robot.model == UNKNOWN_ARM:
        raise ConfigError("robot-model-not-told", known=", ".join(MODELS))
    if (model := MODELS.get(robot.model)) is None:
        raise ConfigError("unknown-robot-model", model=robot.model, known=", ".join(MODELS))
    if (k := robot.kinematics) is not None:
        model = model.calibrated(k.a_m, k.d_m, k.alpha_rad, k.theta_rad)
    return model


def cell_geometry(config: StationConfig) -> CellGeometry:
    """Make the geometry for checks before motion: solids and obstacles by the initial poses where given.

    A camera or board on the flange gets thicker by three sigmas, at most 30 mm; the clearance of one that is
    fixed in the cell grows by two. Configured solids on the flange are taken as exact. The axes of a factory
    calibration are restated: its frames may lie metres away from the arm.
    """
    camera, board, limits = config.camera_guess, config.board_guess, config.limits
    in_hand = config.mount == "eye-in-hand"
    solids, clearance = limits.solids, limits.clearance_m
    obstacles: tuple[Capsule, ...] = ()
    watched: tuple[Vector3, ...] = ()
    if camera is not None:
        X = guess_matrix(camera)
        if in_hand:
            watched = (vector3(X[:3, 3]),)
            radius_m = _CAMERA_RADIUS_M + _thicker_m(camera.sigma_m)
            solids = solids or (camera_body(X, radius_m),)
        else:
            obstacles = (camera_body(X, _CAMERA_RADIUS_M),)
            clearance += 2 * camera.sigma_m
    if board is not None:
        Y = guess_matrix(board)
        rods = plate("board", Y, *board_extent(config.board))
        if in_hand:
            obstacles, clearance = rods, limits.board_clearance_m + 2 * board.sigma_m
        else:
            thicker_m = _thicker_m(board.sigma_m)
            solids += tuple(msgspec.structs.replace(rod, radius_m=rod.radius_m + thicker_m) for rod in rods)
            watched = tuple(vector3(p) for p in transform_points(Y, printed_corners(config.board)))
    model = with_near_axes(arm_model(config.robot))
    return CellGeometry(model, limits, solids, obstacles, clearance, watched, config.mount)


def approval_sha256(plan: Plan, config: StationConfig) -> str:
    """Compute the hash that an approval names: of a plan, the arm, and all that its path is checked by.

    Whatever `cell_geometry` reads belongs into it.
    """
    robot = (config.robot.model, config.robot.serial, config.robot.kinematics)
    places = (config.mount, config.camera_guess, config.board, config.board_guess)
    content = msgspec.json.encode((plan, robot, places, config.limits), order="deterministic")
    return hashlib.sha256(content).hexdigest()


def camera_body(parent_from_camera: Array, radius_m: float) -> Capsule:
    """Make the capsule of a camera, behind its optical centre."""
    ends = transform_points(parent_from_camera, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -_CAMERA_BODY_M]]))
    return Capsule("camera", vector3(ends[0]), vector3(ends[1]), radius_m)


def _thicker_m(sigma_m: float) -> float:
    return min(_DOUBT * sigma_m, _MOST_DOUBT_M)


def require_kept_clear(config: StationConfig) -> None:
    """Raise unless camera and board can be kept clear of what they would hit.

    ConfigError: it is not known where one of them is, unless it is drawn in `limits.solids`. LimitError: the
    pose of the one on the flange is too uncertain for the collision checks.
    """
    in_hand = config.mount == "eye-in-hand"
    drawn = in_hand and config.limits.solids
    for name, on_flange in (("camera_guess", in_hand), ("board_guess", not in_hand)):
        guess: PoseGuess | None = getattr(config, name)
        if on_flange and drawn:
            continue
        if guess is None:
            raise ConfigError("no-guess", missing=name)
        if on_flange and guess.sigma_m > _MOST_DOUBT_M:
            raise LimitError("guess-too-rough", guess=name, sigma_m=guess.sigma_m, limit_m=_MOST_DOUBT_M)
