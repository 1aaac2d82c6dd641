"""The cell as configured: camera and board pose with their uncertainty, solids and obstacles."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from calibrate.boards.model import board_points
from calibrate.geometry import (
    Array,
    inverse,
    perturb,
    pose_from_quaternion,
    pose_from_rotvec,
    quaternion_from_matrix,
    rotation_log,
    transform_points,
)
from calibrate.kinematics import MODELS, RobotModel, forward
from calibrate.projection import camera_matrix
from calibrate.views import board_in_camera, implied_flange
from recordings.schema.messages import BoardSpec, CameraModel, Mount, RobotState, Vector6
from station.cell.collision import SPACING_M, CellGeometry, gap_to_arm, plate
from station.cell.config import (
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
from station.cell.plan import Plan, PlannedPose

_CAMERA_BODY_M, _CAMERA_RADIUS_M = 0.05, 0.035
_DOUBT = 3.0
"""Sigmas by which a body on a guess is thickened: nothing else keeps a wrong mount off the arm."""
_MOST_DOUBT_M = 0.03
"""A camera thicker than this could not stand beside any wrist: `station new` makes a guess better."""
_DRAWS = 2000


@dataclass(frozen=True, eq=False)
class Scene:
    """A guess of the cell, good to the sigmas it carries."""

    mount: Mount
    camera: CameraModel
    board: BoardSpec
    X: Array
    """flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand), (4, 4)"""
    Y: Array
    """base_from_board (eye-in-hand) or flange_from_board (eye-to-hand), (4, 4)"""
    geometry: CellGeometry
    x_sigma: tuple[float, float] = (0.0, 0.0)
    """Per axis: metres, radians."""
    y_sigma: tuple[float, float] = (0.0, 0.0)
    working_distance_m: float = 0.5

    def camera_from_board(self, base_from_flange: Array) -> Array:
        """(..., 4, 4) → (..., 4, 4)"""
        return board_in_camera(self.mount, base_from_flange, self.X, self.Y)

    def base_from_flange(self, camera_from_board: Array) -> Array:
        """The flange pose that shows the board so."""
        return implied_flange(self.mount, self.X, self.Y, camera_from_board)

    def seen(self, base_from_flange: Array, points: Array) -> Array:
        """Board points (k, 3) in `camera`, (n, k, 3)."""
        return transform_points(self.camera_from_board(base_from_flange), points)


def board_place(mount: Mount, base_from_flange: Array, X: Array, camera_from_board: Array) -> Array:
    """base_from_board (eye-in-hand) or flange_from_board (eye-to-hand)."""
    if mount == "eye-in-hand":
        return np.asarray(base_from_flange @ X @ camera_from_board)
    return np.asarray(inverse(base_from_flange) @ X @ camera_from_board)


def frustum(camera: CameraModel, base_from_camera: Array, far_m: float) -> Array:
    """Optical centre and, around it, the image's corners at this distance, (5, 3) in `base`."""
    w, h = camera.width, camera.height
    corners = np.array([(0, 0, 1), (w, 0, 1), (w, h, 1), (0, h, 1)]) @ np.linalg.inv(camera_matrix(camera)).T
    return transform_points(base_from_camera, np.vstack([np.zeros(3), far_m * corners]))


def pose_at(model: RobotModel, name: str, joints_rad: ArrayLike, why: str = "") -> PlannedPose:
    """A pose of a plan, with where the flange is expected; joints (6,)."""
    joints = np.asarray(joints_rad, dtype=float)
    return PlannedPose(name, vector6(joints), matrix4(forward(model, joints)), why=why)


def flange_poses(scene: Scene, plan: Plan) -> Array:
    """(n, 4, 4) base_from_flange of the plan's joints."""
    joints = np.array([pose.joints_rad for pose in plan.poses]).reshape(-1, 6)
    return np.asarray(forward(scene.geometry.model, joints))


def board_extent(board: BoardSpec) -> tuple[Array, Array]:
    """Corners (2,) of the printed area in the board's plane, one square beyond the outermost points."""
    points = board_points(board)[:, :2]
    return points.min(axis=0) - board.square_m, points.max(axis=0) + board.square_m


def printed_corners(board: BoardSpec) -> Array:
    """The same corners in order around it, (4, 3) in `board`."""
    (x0, y0), (x1, y1) = board_extent(board)
    return np.array([(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)])


def scene_of(config: StationConfig) -> Scene:
    """The scene that the configuration describes. ConfigError names what is missing."""
    camera, mount_guess, place_guess = config.camera.model, config.camera_guess, config.board_guess
    if camera is None or camera.matrix is None:
        raise ConfigError(
            "planning needs rough intrinsics",
            code="no-lens",
            remedy="Give camera.model with width, height and matrix (focal length in pixels = lens mm / "
            "pixel size mm; the centre = half the image).",
        )
    if mount_guess is None or place_guess is None:
        missing = "camera_guess" if mount_guess is None else "board_guess"
        raise ConfigError(
            f"planning needs {missing} in the configuration",
            code="no-guess",
            remedy="Add it, or let `station new` find it.",
            missing=missing,
        )
    return Scene(
        config.mount,
        camera,
        config.board,
        X=guess_matrix(mount_guess),
        Y=guess_matrix(place_guess),
        geometry=cell_geometry(config),
        x_sigma=(mount_guess.sigma_m, mount_guess.sigma_rad),
        y_sigma=(place_guess.sigma_m, place_guess.sigma_rad),
        working_distance_m=config.working_distance_m,
    )


def guess_matrix(guess: PoseGuess) -> Array:
    """(4, 4)"""
    return pose_from_quaternion(guess.translation_m, guess.rotation_xyzw)


def guess_from(matrix: Array, sigma_m: float, sigma_rad: float) -> PoseGuess:
    """A transform (4, 4) as the configuration writes it."""
    quaternion = quaternion_from_matrix(matrix[:3, :3])
    x, y, z, w = (float(value) for value in quaternion)
    return PoseGuess(vector3(matrix[:3, 3]), (x, y, z, w), sigma_m, sigma_rad)


def cell_geometry(config: StationConfig) -> CellGeometry:
    """Geometry for checks before motion; uses the guesses where there are any, and their sigmas."""
    camera, board = config.camera_guess, config.board_guess
    return geometry_of(
        config,
        None if camera is None else guess_matrix(camera),
        None if board is None else guess_matrix(board),
        0.0 if camera is None else camera.sigma_m,
        0.0 if board is None else board.sigma_m,
    )


def arm_model(robot: RobotConfig) -> RobotModel:
    """The configured arm, with its factory calibration where it is given. ConfigError: not known."""
    if (model := MODELS.get(robot.model)) is None:
        raise ConfigError(
            f"robot.model '{robot.model}' is unknown",
            code="unknown-robot-model",
            remedy=f"Use one of {', '.join(MODELS)}.",
        )
    if (k := robot.kinematics) is not None:
        model = model.calibrated(k.a_m, k.d_m, k.alpha_rad, k.theta_rad)
    return model


def geometry_of(
    config: StationConfig,
    X: Array | None,
    Y: Array | None,
    camera_doubt_m: float = 0.0,
    board_doubt_m: float = 0.0,
) -> CellGeometry:
    """Solids and obstacles of a cell, for a camera and a board that may be off by so much (one sigma).

    What is on the flange gets thicker by three sigmas, 30 mm at most; clearance to what stands in the cell
    grows by two. Solids that the configuration draws on the flange are taken as they are.
    """
    low, high = board_extent(config.board)
    limits = config.limits
    solids = limits.solids
    obstacles: tuple[Capsule, ...] = ()
    watched: tuple[Vector3, ...] = ()
    clearance = limits.clearance_m
    if config.mount == "eye-in-hand":
        if X is not None:
            watched = (vector3(X[:3, 3]),)
            solids = solids or (camera_body("camera", X, camera_radius_m(camera_doubt_m)),)
        if Y is not None:
            obstacles = plate("board", Y, low, high)
            clearance = limits.board_clearance_m + 2 * board_doubt_m
    else:
        if Y is not None:
            thicker_m = _thicker_m(board_doubt_m)
            solids += tuple(
                msgspec.structs.replace(rod, radius_m=rod.radius_m + thicker_m)
                for rod in plate("board", Y, low, high)
            )
            watched = tuple(vector3(p) for p in transform_points(Y, printed_corners(config.board)))
        if X is not None:
            obstacles = (camera_body("camera", X),)
            clearance = limits.clearance_m + 2 * camera_doubt_m
    model = arm_model(config.robot)
    return CellGeometry(model, limits, solids, obstacles, clearance, watched, config.mount)


def _thicker_m(sigma_m: float) -> float:
    return min(_DOUBT * sigma_m, _MOST_DOUBT_M)


def require_kept_clear(config: StationConfig) -> None:
    """LimitError when what hangs on a guess may well be (1 sigma) where no check keeps clear of."""
    name = "camera_guess" if config.mount == "eye-in-hand" else "board_guess"
    guess: PoseGuess | None = getattr(config, name)
    drawn = config.mount == "eye-in-hand" and config.limits.solids
    if guess is None or drawn or guess.sigma_m <= _MOST_DOUBT_M:
        return
    raise LimitError(
        f"{name} is known to {1000 * guess.sigma_m:.0f} mm only (limit {1000 * _MOST_DOUBT_M:.0f} mm): "
        "moves of a plan might touch something",
        code="guess-too-rough",
        remedy="Let `station new` find it, or measure it better.",
        sigma_m=guess.sigma_m,
        limit_m=_MOST_DOUBT_M,
    )


def covers_its_doubt(guess: PoseGuess) -> bool:
    """Tell whether what hangs on the flange gets as much thicker as it may be off."""
    return _DOUBT * guess.sigma_m <= _MOST_DOUBT_M


def camera_radius_m(sigma_m: float) -> float:
    """Radius of a camera on the flange whose place is known to `sigma_m`."""
    return _CAMERA_RADIUS_M + _thicker_m(sigma_m)


def camera_ends(parent_from_camera: Array) -> Array:
    """(..., 4, 4) → (..., 2, 3): the camera's body, from the optical centre back."""
    return transform_points(parent_from_camera, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -_CAMERA_BODY_M]]))


def camera_body(name: str, parent_from_camera: Array, radius_m: float = _CAMERA_RADIUS_M) -> Capsule:
    """A camera as it stands behind its optical centre."""
    ends = camera_ends(parent_from_camera)
    return Capsule(name, vector3(ends[0]), vector3(ends[1]), radius_m)


def geometry_from(config: StationConfig, standing_rad: ArrayLike) -> CellGeometry:
    """Geometry for checks of a motion that begins where the arm stands, joints (6,).

    A rough guess can put the camera where a part of the arm is. Then the guess is wrong, since the arm stands
    there: the nearest mount by its sigmas that has room takes its place, as thick as the guessed one was. A
    guess that is sharp enough for its thickness to cover its doubt is taken as it is.
    """
    guess, board = config.camera_guess, config.board_guess
    cell = cell_geometry(config)
    if guess is None or config.mount != "eye-in-hand" or config.limits.solids or covers_its_doubt(guess):
        return cell
    draws = np.random.default_rng(0).normal(size=(_DRAWS, 6))
    draws[0] = 0.0
    nearest = draws[np.argsort((draws**2).sum(axis=1))] * np.repeat([guess.sigma_m, guess.sigma_rad], 3)
    mounts = perturb(guess_matrix(guess), nearest)
    standing = np.asarray(standing_rad, dtype=float)
    ends = camera_ends(forward(cell.model, standing) @ mounts)
    room_m = gap_to_arm(cell, standing, ends[:, 0], ends[:, 1]) - camera_radius_m(guess.sigma_m)
    roomy = np.flatnonzero(room_m >= SPACING_M)
    if room_m[0] >= SPACING_M / 2 or len(roomy) == 0:  # what the check of a path wants
        return cell
    Y, board_m = (None, 0.0) if board is None else (guess_matrix(board), board.sigma_m)
    return geometry_of(config, mounts[roomy[0]], Y, guess.sigma_m, board_m)


def pose_vector(matrix: Array) -> Vector6:
    """A pose (4, 4) as UR writes it: x, y, z [m] and a rotation vector [rad]."""
    return vector6([*matrix[:3, 3], *rotation_log(matrix[:3, :3])])


def flange_pose(state: RobotState, tcp_offset: Vector6) -> Array:
    """base_from_flange (4, 4): the controller's own tool pose without the tool."""
    base_from_tcp = pose_from_rotvec(state.tcp_pose[:3], state.tcp_pose[3:])
    return np.asarray(base_from_tcp @ inverse(pose_from_rotvec(tcp_offset[:3], tcp_offset[3:])))
