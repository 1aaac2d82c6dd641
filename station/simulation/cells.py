"""Simulated cells: that of the paper, and others by seed.

Seed 0 is the cell as published. Other seeds turn and lean the camera and draw the board's pose, the lens and
noise. The arm starts where the camera looks at the board.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from calibrate.arms.kinematics import MODELS, forward
from calibrate.boards.model import board_points
from recordings.geometry import Array, inverse, pose, project_to_rotation, rotation_exp
from recordings.schema.messages import BoardSpec, CameraModel, Matrix4, Mount, Vector6
from station.cell.config import (
    PAPER_BOARD,
    CameraConfig,
    CaptureConfig,
    LimitsConfig,
    Plane,
    PoseGuess,
    RobotConfig,
    StationConfig,
    matrix4,
    vector6,
)
from station.cell.layout import guess_from
from station.simulation.renderer import scaled
from station.simulation.truth import CellTruth, Light, NoiseLevel, SceneName

ROBOT = "UR10"
_PRINTED_X = np.array(
    [
        (1.0000, -0.0032, -0.0026, -0.0013),
        (0.0032, 1.0000, -0.0068, -0.0603),
        (0.0026, 0.0068, 1.0000, 0.0870),
    ]
)
PAPER_X = pose(project_to_rotation(_PRINTED_X[:, :3]), _PRINTED_X[:, 3])
"""flange_from_camera of eq. 23 of the paper, where it is rounded"""
_FOCAL_PX = 8.0 / 0.0048
PAPER_LENS = CameraModel(
    width=1280,
    height=1024,
    matrix=((_FOCAL_PX + 3.1, 0.0, 646.2), (0.0, _FOCAL_PX + 2.7, 505.8), (0.0, 0.0, 1.0)),
    distortion=(-0.092, 0.118, 0.0004, -0.0003, 0.0),
)
_LENSES = {"paper": PAPER_LENS, "paper-binned": scaled(PAPER_LENS, 0.5)}
_START_RAD = {
    "eye-in-hand": np.deg2rad([0.0, -94.0, -90.0, -86.0, 90.0, 0.0]),
    "eye-to-hand": np.deg2rad([0.0, -94.0, -90.0, 4.0, 90.0, 0.0]),
}
"""Start joints: the flange points straight down, half a metre above the table; or away from the arm."""
_LEAN_RAD, _JOG_RAD = 0.3, 0.06
"""How far other seeds lean the camera or turn each joint, at most."""
FREE_SPACE_BYTES = 200_000_000
"""Free disk space below which no pose is captured; small, so that demonstrations run anywhere."""
TABLE = Plane("table", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""Table on which the arm stands."""
_GUESS_M, _GUESS_RAD = 0.004, 0.02
"""1σ per axis of the errors of the configured initial poses"""


class _CellNoise(NamedTuple):
    robot_sigma_m: float
    robot_sigma_rad: float
    dh_sigma_m: float
    dh_sigma_rad: float
    pixel_noise: float
    blur_px: float
    factory_mm: float = 0.0
    """1σ of the factory calibration against the published table, mm and mrad."""


_NOISE = {
    "low": _CellNoise(5.0e-5, 8.7e-5, 0.0, 0.0, 2.0, 0.7),
    "mid": _CellNoise(1.0e-4, 1.7e-4, 1.0e-4, 1.0e-4, 4.0, 0.9),
    "high": _CellNoise(2.0e-4, 3.5e-4, 6.0e-4, 6.0e-4, 7.0, 1.2, 0.7),
}
_FAR_M = 0.6


def make_cell(
    scene: SceneName = "paper", seed: int = 0, noise: NoiseLevel = "low", mount: Mount = "eye-in-hand"
) -> CellTruth:
    """Make the truth of a cell; equal arguments give the same cell."""
    rng = np.random.default_rng([2026, seed])
    camera = _LENSES[scene] if seed == 0 else _other_lens(_LENSES[scene], rng)
    X, Y, start = _before_camera(rng) if mount == "eye-to-hand" else _before_board(seed, rng)
    truth = CellTruth(
        scene=scene,
        seed=seed,
        mount=mount,
        robot_model=ROBOT,
        board=PAPER_BOARD,
        camera=camera,
        camera_mount=matrix4(X),
        board_place=matrix4(Y),
        start_joints_rad=vector6(start),
    )
    return _with_noise(truth, _NOISE[noise], rng)


def board_centre(board: BoardSpec) -> Array:
    points = board_points(board)
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def seen_from(board: BoardSpec, distance_m: float, rotation: Array | None = None) -> Array:
    """Make camera_from_board with the board's centre on the optical axis."""
    R = np.eye(3) if rotation is None else rotation
    return pose(R, np.array([0.0, 0.0, distance_m]) - R @ board_centre(board))


def _turned(rng: np.random.Generator, lean_rad: float) -> Array:
    """Draw a rotation (3, 3): any turn about z, and a lean of at most `lean_rad` about x and y each."""
    lean = rotation_exp([*rng.uniform(-lean_rad, lean_rad, 2), 0.0])
    return lean @ rotation_exp([0.0, 0.0, rng.uniform(-np.pi, np.pi)])


def _before_board(seed: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Place the board on the table where a camera on the flange looks; return X, Y and start joints."""
    X, start, height_m = PAPER_X, _START_RAD["eye-in-hand"], 0.0
    around = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    if seed != 0:
        X = pose(_turned(rng, 0.0), [0.0, 0.0, 0.0]) @ X @ pose(_turned(rng, _LEAN_RAD), [0.0, 0.0, 0.0])
        start = start + rng.uniform(-_JOG_RAD, _JOG_RAD, 6)
        height_m, around = rng.uniform(0.0, 0.03), around @ _turned(rng, 0.0)
    base_from_camera = forward(MODELS[ROBOT], start) @ X
    axis, eye = base_from_camera[:3, 2], base_from_camera[:3, 3]
    middle = eye + axis * (height_m - eye[2]) / axis[2]
    return X, pose(around, middle - around @ board_centre(PAPER_BOARD)), start


def _before_camera(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Place a fixed camera before a board on the flange, which faces away from the arm."""
    start = _START_RAD["eye-to-hand"] + rng.uniform(-_JOG_RAD, _JOG_RAD, 6)
    turn = rotation_exp([np.pi, 0.0, 0.0]) @ _turned(rng, 0.1)
    beside_m = [*rng.uniform(-0.01, 0.01, 2), rng.uniform(0.03, 0.06)]
    Y = pose(turn, np.array(beside_m) - turn @ board_centre(PAPER_BOARD))
    view = seen_from(PAPER_BOARD, rng.uniform(0.48, 0.55), _turned(rng, 0.2))
    return forward(MODELS[ROBOT], start) @ Y @ inverse(view), Y, start


def _other_lens(camera: CameraModel, rng: np.random.Generator) -> CameraModel:
    """Draw a lens with slightly different focal length, centre and distortion."""
    assert camera.matrix is not None
    focal = camera.matrix[0][0] * rng.uniform(0.97, 1.03)
    cx, cy = camera.matrix[0][2] + rng.normal(0, 6), camera.matrix[1][2] + rng.normal(0, 6)
    k1 = rng.uniform(-0.12, 0.04)
    tangential = rng.normal(0, 3e-4, 2)
    return msgspec.structs.replace(
        camera,
        matrix=((focal, 0.0, cx), (0.0, focal * (1 + rng.normal(0, 3e-4)), cy), (0.0, 0.0, 1.0)),
        distortion=(k1, -k1 * rng.uniform(0.5, 1.3), float(tangential[0]), float(tangential[1]), 0.0),
    )


def _with_noise(truth: CellTruth, level: _CellNoise, rng: np.random.Generator) -> CellTruth:
    spread = 1.0 if truth.seed == 0 else float(rng.uniform(0.8, 1.2))

    sigmas = (level.dh_sigma_m, level.dh_sigma_m, level.dh_sigma_rad, level.dh_sigma_rad)
    deltas = [rng.normal(0, sigma, 6) if sigma else np.zeros(6) for sigma in sigmas]
    factory = np.zeros((4, 6))
    if level.factory_mm:
        factory = 1e-3 * level.factory_mm * np.random.default_rng([1945, truth.seed]).normal(size=(4, 6))
        # The common normal of nearly parallel axes may be far off, as in real factory calibrations.
        factory[1, 1:4] += _FAR_M * np.array([1.0, -0.4, -0.6])
        factory[[0, 2], 5] = 0.0
    tables: dict[str, Vector6] = {}
    for i, column in enumerate(("a_m", "d_m", "alpha_rad", "theta_rad")):
        tables |= {f"factory_{column}": vector6(factory[i]), f"dh_delta_{column}": vector6(deltas[i])}
    return msgspec.structs.replace(
        truth,
        **tables,
        robot_sigma_m=level.robot_sigma_m * spread,
        robot_sigma_rad=level.robot_sigma_rad * spread,
        light=Light(pixel_noise=level.pixel_noise * spread, blur_px=level.blur_px * spread),
        camera_clock_offset_ns=int(rng.integers(-(10**12), 10**12)),
    )


def cell_config(truth: CellTruth, host: str = "") -> StationConfig:
    """Make a configuration as by an operator with a tape measure: rough camera pose, board pose and lens.

    `host`: the simulated controller. The same truth gives the same configuration.
    """
    rng = np.random.default_rng([1987, truth.seed])

    def roughly(matrix: Matrix4) -> PoseGuess:
        M = np.array(matrix)
        turned = M[:3, :3] @ rotation_exp(
            np.clip(rng.normal(0, _GUESS_RAD, 3), -2 * _GUESS_RAD, 2 * _GUESS_RAD)
        )
        moved = M[:3, 3] + np.clip(rng.normal(0, _GUESS_M, 3), -2 * _GUESS_M, 2 * _GUESS_M)
        return guess_from(pose(turned, moved), _GUESS_M, _GUESS_RAD)

    assert truth.camera.matrix is not None
    focal_px = round(truth.camera.matrix[0][0], -1)
    centre = ((truth.camera.width - 1) / 2, (truth.camera.height - 1) / 2)
    rough_lens = CameraModel(
        width=truth.camera.width,
        height=truth.camera.height,
        matrix=((focal_px, 0.0, centre[0]), (0.0, focal_px, centre[1]), (0.0, 0.0, 1.0)),
    )
    mount_guess, board_guess = roughly(truth.camera_mount), roughly(truth.board_place)
    return StationConfig(
        name="simulated",
        mount=truth.mount,
        robot=RobotConfig(model=truth.robot_model, host=host),
        camera=CameraConfig(driver="rendered", model=rough_lens, model_is_rough=True),
        board=truth.board,
        camera_guess=mount_guess,
        board_guess=board_guess,
        limits=LimitsConfig(planes=(TABLE,)),
        capture=CaptureConfig(free_space_bytes=FREE_SPACE_BYTES),
    )
