"""False alarms of the drift check, and detections of 0.5 mm or 0.1°.

Views are corners with noise on corners and robot, 0.45 m from the paper's board; the installed X has an error
of its own, drawn from its covariance. Shifts and turns have random directions. Poses are random, as of an arm
moved by hand; chosen by the planner's criterion out of 200 random ones; or planned as `station check` does,
by the whole planner with its limits and obstacles, on random cells whose guesses are wrong by their sigmas
(camera on the flange: `random_cells`; beside the cell: the simulation's own cells).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.random_cells import random_cell
from benchmarks.trials import share_spread, table, trials
from calibrate.boards.model import board_points
from calibrate.geometry import Array, inverse, perturb, pose, rotation_exp
from calibrate.handeye.information import MeasurementNoise as PlanNoise
from calibrate.handeye.information import prior_information, view_information
from calibrate.handeye.priors import BoardTolerance
from calibrate.lens.pnp import solve_pnp
from calibrate.projection import project_at
from calibrate.quality.drift import SHIFT_M, TURN_RAD, DriftCheck, Noise, judge_shift
from calibrate.views import BoardView, ViewSet
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel, Mount
from station.plan.choose import Objective, choose
from station.plan.planner import make_plan
from station.simulation.cells import cell_config, make_cell

TRIALS = 400
SETS, POOL = 20, 200
"""So many choices of poses take turns; each out of a pool of its own."""
_DEGREES_OF_FREEDOM = 69.0
"""Covariance of a calibration from 25 views."""
_CAMERA = CameraModel(1280, 1024, ((1667.0, 0, 639.5), (0, 1667.0, 511.5), (0, 0, 1)), (0.0,) * 5)
_BOARD = BoardSpec(kind=BoardKind.CHESSBOARD, columns=7, rows=6, square_m=0.025)
_PLACE = pose(rotation_exp([np.pi - 0.2, 0.1, 0.4]), [0.6, 0.1, 0.0])
_MOUNT = pose(rotation_exp([0.1, -0.2, 1.5]), [0.06, -0.07, 0.05])
_OBJECTIVE = Objective("A", 0.45, prior_information(_CAMERA, True, BoardTolerance()), None)
"""Objective as the planner's own (`objective_for`), the lens known."""


@dataclass(frozen=True, eq=False)
class _Set:
    """Poses of one check."""

    seen: list[Array]
    """camera_from_board"""
    X: Array
    Y: Array


@dataclass(frozen=True)
class _Level:
    """One of the simulated cell's noise levels."""

    name: str
    noise: Noise
    installed_m: float
    """Per axis, what 25 views leave of doubt about the installed X."""
    installed_rad: float

    @property
    def covariance(self) -> Array:
        return np.diag([self.installed_m**2] * 3 + [self.installed_rad**2] * 3)


LOW = _Level("low", Noise(0.1, 5.0e-5, 8.7e-5, _DEGREES_OF_FREEDOM), 3.0e-5, 6.1e-5)
MID = _Level("mid", Noise(0.15, 1.0e-4, 1.7e-4, _DEGREES_OF_FREEDOM), 6.0e-5, 1.2e-4)


def run() -> str:
    count = trials(TRIALS)
    mounts: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
    rows = [_row(MID, "planned", views, mount, count) for mount in mounts for views in (3, 4, 5, 6, 8)]
    rows += [
        _row(level, poses, views, mount, count)
        for level in (LOW, MID)
        for poses in ("chosen", "random")
        for views in (3, 5, 6, 10)
        for mount in mounts
    ]
    spread = 100 * share_spread(0.95, count)
    noises = "; ".join(
        f"{v.name} {v.noise.corner_px:g} px, {1e3 * v.noise.robot_m:g} mm, "
        f"{np.degrees(v.noise.robot_rad):.3f}°"
        for v in (LOW, MID)
    )
    text = (
        f"{count} trials per number (one standard error of 5 % or 95 %: {spread:.1f} %). Noise (corner, "
        f"robot per axis): {noises}. 'Stated' is the power that the check itself prints, for the direction "
        "that is hardest to see; the shifts here have random directions."
    )
    header = [
        "noise",
        "poses",
        "views",
        "mount",
        "false alarms %",
        "0.5 mm noticed %",
        "stated %",
        "0.1° noticed %",
    ]
    return text + "\n\n" + table([*header, "stated %"], rows)


def _row(level: _Level, poses: str, views: int, mount: Mount, count: int) -> list[object]:
    sets = _sets(level, poses, views, mount, count if poses == "random" else SETS)
    quiet = _checks(level, sets, mount, count, 0.0, 0.0, 1)
    shifted = _checks(level, sets, mount, count, SHIFT_M, 0.0, 2)
    turned = _checks(level, sets, mount, count, 0.0, TURN_RAD, 3)
    return [
        level.name,
        poses,
        views,
        mount,
        _alarms(quiet),
        _alarms(shifted),
        f"{100 * np.mean([c.power_translation for c in quiet]):.0f}",
        _alarms(turned),
        f"{100 * np.mean([c.power_rotation for c in quiet]):.0f}",
    ]


def _alarms(checks: list[DriftCheck]) -> str:
    return f"{100 * np.mean([not c.passed for c in checks]):.1f}"


def _sets(level: _Level, poses: str, views: int, mount: Mount, count: int) -> list[_Set]:
    """So many times `views` poses."""
    rng = np.random.default_rng(views)
    if poses == "planned":
        return [_planned(views, seed, mount) for seed in range(count)]
    if poses == "random":
        seen = [[_seen(rng) for _ in range(views)] for _ in range(count)]
    else:
        seen = [_choice(level, views, mount, rng) for _ in range(count)]
    return [_Set(each, _MOUNT, _PLACE) for each in seen]


def _planned(views: int, seed: int, mount: Mount) -> _Set:
    if mount == "eye-in-hand":
        cell, _ = random_cell(seed)
        config, start, X, Y = cell.config, cell.start, cell.X, cell.Y
    else:
        truth = make_cell("paper", 1 + seed, "mid", mount)  # seed 0 is the published place
        config, start = cell_config(truth), np.array(truth.start_joints_rad)
        X, Y = np.array(truth.camera_mount), np.array(truth.board_place)
    plan = make_plan(config, start_joints_rad=start.tolist(), count=views, lens_known=True)
    flanges = [np.array(each.base_from_flange) for each in plan.poses]
    in_hand = mount == "eye-in-hand"
    seen = [inverse(E @ X) @ Y if in_hand else inverse(X) @ E @ Y for E in flanges]
    return _Set(seen, X, Y)


def _choice(level: _Level, views: int, mount: Mount, rng: np.random.Generator) -> list[Array]:
    pool = [_seen(rng) for _ in range(POOL)]
    flanges = np.array([_flange(seen, mount, _MOUNT, _PLACE) for seen in pool])
    noise = PlanNoise(level.noise.corner_px, level.noise.robot_m, level.noise.robot_rad)
    points = board_points(_BOARD)
    information = view_information(mount, _CAMERA, flanges, _MOUNT, _PLACE, points, noise)
    return [pool[k] for k in choose(information, views, _OBJECTIVE, rng)]


def _checks(
    level: _Level,
    sets: list[_Set],
    mount: Mount,
    count: int,
    shift_m: float,
    turn_rad: float,
    seed: int,
) -> list[DriftCheck]:
    rng = np.random.default_rng([seed, len(sets[0].seen)])
    root = np.linalg.cholesky(level.covariance)
    found = []
    for trial in range(count):
        way = rng.normal(size=(2, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        poses = sets[trial % len(sets)]
        moved = perturb(poses.X, np.r_[way[0] * shift_m, way[1] * turn_rad])
        installed = perturb(poses.X, root @ rng.normal(size=6))
        new = _views(level.noise, poses, mount, moved, rng)
        found.append(judge_shift(new, installed, level.covariance, level.noise))
    return found


def _views(noise: Noise, poses: _Set, mount: Mount, X: Array, rng: np.random.Generator) -> ViewSet:
    """New views of a cell whose camera is truly at X."""
    points, found = board_points(_BOARD), []
    for k, seen in enumerate(poses.seen):
        error = np.r_[rng.normal(size=3) * noise.robot_m, rng.normal(size=3) * noise.robot_rad]
        pixels = project_at(_CAMERA, seen, points) + rng.normal(size=(len(points), 2)) * noise.corner_px
        found.append(BoardView(k, str(k), perturb(_flange(seen, mount, X, poses.Y), error), points, pixels))
    return solve_pnp(ViewSet(mount, tuple(found), _CAMERA), _BOARD)


def _flange(seen: Array, mount: Mount, X: Array, Y: Array) -> Array:
    return Y @ inverse(X @ seen) if mount == "eye-in-hand" else X @ seen @ inverse(Y)


def _seen(rng: np.random.Generator) -> Array:
    """camera_from_board: near the picture's middle, tilted by 14° to 34°, any roll up to 70°."""
    points = board_points(_BOARD)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    away, about = rng.uniform(0.25, 0.6), rng.uniform(0, 2 * np.pi)
    tilt = rotation_exp([away * np.cos(about), away * np.sin(about), 0.0])
    R = tilt @ rotation_exp([0.0, 0.0, rng.uniform(-1.2, 1.2)])
    aim = np.array([*rng.uniform(-0.035, 0.035, 2), 0.45 * rng.uniform(0.9, 1.25)])
    return pose(R, aim - R @ centre)
