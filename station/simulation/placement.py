"""Placement of camera, board and arm of a simulated cell such that many different views are possible.

A placement is accepted when enough of the planner's candidate poses are reachable without collision.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calibrate.boards.model import board_points
from calibrate.geometry import Array, inverse, pose, rotation_exp, transform_points
from calibrate.kinematics import MODELS, forward, inverse_all, singularity_measure
from recordings.schema.messages import BoardSpec, CameraModel, Mount
from station.cell.collision import body_segments, margins, segment_distance
from station.cell.config import CameraConfig, LimitsConfig, Plane, PoseGuess, RobotConfig, StationConfig
from station.cell.errors import ConfigError
from station.cell.layout import CellLayout, guess_from, layout_of
from station.plan.candidates import find_candidates
from station.plan.visibility import view_range

ROBOT = "UR10"
TABLE = Plane("table", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""Table on which the arm stands."""
_ATTEMPTS = 400
_TRIED_VIEWS = 60
_NEEDED_SHARE = 0.4
"""Smallest accepted share of views that are reachable in the arm branch of the start."""
_START_MARGIN_M = 0.015
_START_SINGULARITY = 0.08


class Placement(NamedTuple):
    camera_mount: Array
    board_place: Array
    start_joints_rad: Array


def board_centre(board: BoardSpec) -> Array:
    points = board_points(board)
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def seen_from(board: BoardSpec, distance_m: float, rotation: Array | None = None) -> Array:
    """Make camera_from_board with the board's centre on the optical axis."""
    R = np.eye(3) if rotation is None else rotation
    return pose(R, np.array([0.0, 0.0, distance_m]) - R @ board_centre(board))


def cell_description(
    mount: Mount,
    camera: CameraModel,
    board: BoardSpec,
    camera_guess: PoseGuess,
    board_guess: PoseGuess,
    host: str = "",
) -> StationConfig:
    """Make the configuration of a simulated cell: UR10 on a table, rendered camera."""
    return StationConfig(
        name="simulated",
        mount=mount,
        robot=RobotConfig(model=ROBOT, host=host),
        camera=CameraConfig(driver="rendered", model=camera, model_is_rough=True),
        board=board,
        camera_guess=camera_guess,
        board_guess=board_guess,
        limits=LimitsConfig(planes=(TABLE,)),
    )


def place_moving_camera(
    board: BoardSpec, camera: CameraModel, camera_turn: Array, rng: np.random.Generator
) -> Placement:
    """Place an eye-in-hand camera, rotated by `camera_turn` (3, 3), above a board on table or stand."""
    for _ in range(_ATTEMPTS):
        around, beside_m, ahead_m = (
            rng.uniform(-np.pi, np.pi),
            rng.uniform(0.06, 0.11),
            rng.uniform(0.03, 0.10),
        )
        X = pose(camera_turn, [beside_m * np.cos(around), beside_m * np.sin(around), ahead_m])
        base_from_camera = _camera_looking_down(rng)
        tilt = rotation_exp([*rng.uniform(-0.2, 0.2, 2), rng.uniform(-np.pi, np.pi)])
        Y = base_from_camera @ seen_from(board, rng.uniform(0.47, 0.53), tilt)
        if _lowest_corner_m(board, Y) < 0.005:
            continue
        layout = _exact_layout("eye-in-hand", camera, board, X, Y)
        start = _comfortable_start(layout, base_from_camera @ inverse(X), rng)
        if start is not None and _sees(layout, start) and _roomy(layout, start, rng):
            return Placement(X, Y, start)
    raise ConfigError("no-placement", mount="eye-in-hand")


def place_fixed_camera(board: BoardSpec, camera: CameraModel, rng: np.random.Generator) -> Placement:
    """Place an eye-to-hand camera beside the cell, and a board on the flange facing away from the arm."""
    outwards = rotation_exp([np.pi, 0.0, 0.0])
    for _ in range(_ATTEMPTS):
        turn = outwards @ rotation_exp([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-np.pi, np.pi)])
        Y = pose(
            turn,
            np.array([*rng.uniform(-0.01, 0.01, 2), rng.uniform(0.03, 0.06)]) - turn @ board_centre(board),
        )
        flange = pose(rotation_exp(rng.normal(size=3) * 2.0), _shell_point(rng))
        look = rotation_exp([*rng.uniform(-0.2, 0.2, 2), rng.uniform(-np.pi, np.pi)])
        X = flange @ Y @ inverse(seen_from(board, rng.uniform(0.48, 0.55), look))
        if X[2, 3] < 0.1 or np.hypot(X[0, 3], X[1, 3]) < 0.4:
            continue
        layout = _exact_layout("eye-to-hand", camera, board, X, Y)
        start = _comfortable_start(layout, flange, rng)
        if start is not None and _sees(layout, start) and _roomy(layout, start, rng):
            return Placement(X, Y, start)
    raise ConfigError("no-placement", mount="eye-to-hand")


def _camera_looking_down(rng: np.random.Generator) -> Array:
    """Draw base_from_camera above the table, at most 50° from looking straight down, with any roll."""
    lean, around = np.deg2rad(rng.uniform(0, 50)), rng.uniform(-np.pi, np.pi)
    axis = np.array([np.cos(around), np.sin(around), 0.0]) * (np.pi - lean)
    turn = rotation_exp(axis) @ rotation_exp([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    return pose(turn, _shell_point(rng))


def _shell_point(rng: np.random.Generator) -> Array:
    """Draw a point that the arm reaches without stretching, in `base`."""
    radius, around = rng.uniform(0.45, 0.85), rng.uniform(-np.pi, np.pi)
    return np.array([radius * np.cos(around), radius * np.sin(around), rng.uniform(0.45, 0.9)])


def _exact_layout(mount: Mount, camera: CameraModel, board: BoardSpec, X: Array, Y: Array) -> CellLayout:
    # 1σ of 20 mm for what is fixed in the cell leaves room for the rough poses of the configuration.
    camera_sigma_m, board_sigma_m = (0.0, 0.02) if mount == "eye-in-hand" else (0.02, 0.0)
    guesses = guess_from(X, camera_sigma_m, 0.0), guess_from(Y, board_sigma_m, 0.0)
    return layout_of(cell_description(mount, camera, board, *guesses))


def _comfortable_start(layout: CellLayout, base_from_flange: Array, rng: np.random.Generator) -> Array | None:
    solutions = inverse_all(MODELS[ROBOT], base_from_flange)
    if len(solutions) == 0:
        return None
    gaps, _ = margins(layout.geometry, solutions)
    free = gaps.min(axis=1) > _START_MARGIN_M
    free &= singularity_measure(MODELS[ROBOT], solutions) > _START_SINGULARITY
    free &= forward(MODELS[ROBOT], solutions)[:, 2, 3] > 0.15
    good = np.flatnonzero(free)
    return None if len(good) == 0 else np.asarray(solutions[rng.choice(good)])


def _sees(layout: CellLayout, joints_rad: Array) -> bool:
    """Tell whether no part of the arm is between the camera and the board's corners."""
    flange = forward(MODELS[ROBOT], joints_rad)
    in_hand = layout.mount == "eye-in-hand"
    base_from_board = layout.Y if in_hand else flange @ layout.Y
    eye = (flange @ layout.X if in_hand else layout.X)[:3, 3]
    corners = transform_points(base_from_board, board_points(layout.board))
    starts, ends, radii = body_segments(layout.geometry, joints_rad[None])
    arm = slice(0, 7)
    gap = segment_distance(eye[None, None], corners[:, None], starts[:, arm], ends[:, arm])
    limit = radii[arm] + 0.005 if in_hand else np.minimum(radii[arm], 0.03)
    return bool((gap > limit).all())


def _roomy(layout: CellLayout, start: Array, rng: np.random.Generator) -> bool:
    """Tell whether enough varied views are reachable without changing the arm branch."""
    found = find_candidates(layout, replace(view_range(layout), doubt=0.0), _TRIED_VIEWS, rng, start)
    if len(found) == 0:
        return False
    near = np.abs(found.joints_rad - start).max(axis=1) < 2.6
    in_branch = np.bincount(found.branch[near]) if near.any() else np.zeros(1)
    return bool(in_branch.max() >= _NEEDED_SHARE * _TRIED_VIEWS)


def _lowest_corner_m(board: BoardSpec, base_from_board: Array) -> float:
    points = board_points(board)
    reach = 2 * board.square_m
    low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
    corners = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    return float(transform_points(base_from_board, corners)[:, 2].min())
