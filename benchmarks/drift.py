"""False alarms of the drift check, and detections of 0.5 mm or 0.1°.

Views are corners with noise on corners and robot, 0.45 m from the paper's board; the installed X has an error
of its own, drawn from its covariance. Shifts and turns have random directions. Poses are planned as
`station drift-check` does, by the whole planner with its limits and obstacles, on cells whose guesses are
wrong by their sigmas (camera on the flange: `random_cells`; beside the cell: the simulation's own cells).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.random_cells import random_cell
from benchmarks.trials import share_spread, table, trials
from calibrate.boards.model import board_points
from calibrate.geometry import Array, inverse, perturb
from calibrate.lens.pnp import solve_pnp
from calibrate.projection import project_at
from calibrate.quality.drift import SHIFT_M, TURN_RAD, DriftCheck, Noise, judge_shift
from calibrate.views import BoardView, ViewSet
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel, Mount
from station.plan.planner import make_plan
from station.simulation.cells import cell_config, make_cell

TRIALS = 400
SETS = 20
"""Plans that take turns, each of a cell of its own."""
_DEGREES_OF_FREEDOM = 69.0
"""Covariance of a calibration from 25 views."""
_CAMERA = CameraModel(1280, 1024, ((1667.0, 0, 639.5), (0, 1667.0, 511.5), (0, 0, 1)), (0.0,) * 5)
_BOARD = BoardSpec(kind=BoardKind.CHESSBOARD, columns=7, rows=6, square_m=0.025)
NOISE = Noise(0.15, 1.0e-4, 1.7e-4, _DEGREES_OF_FREEDOM)
COVARIANCE = np.diag(np.repeat([6.0e-5, 1.2e-4], 3) ** 2)
"""What 25 views leave of doubt about the installed X."""


@dataclass(frozen=True, eq=False)
class _Set:
    """Poses of one check."""

    seen: list[Array]
    """camera_from_board"""
    X: Array
    Y: Array


def run() -> str:
    count = trials(TRIALS)
    mounts: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
    rows = [_row(views, mount, count) for mount in mounts for views in (3, 4, 5, 6, 8)]
    spread = 100 * share_spread(0.95, count)
    text = (
        f"{count} trials per number (one standard error of 5 % or 95 %: {spread:.1f} %). Noise (corner, "
        f"robot per axis): {NOISE.corner_px:g} px, {1e3 * NOISE.robot_m:g} mm, "
        f"{np.degrees(NOISE.robot_rad):.3f}°. 'Stated' is the power that the check itself prints, for the "
        "direction that is hardest to see; the shifts here have random directions."
    )
    noticed = ("0.5 mm noticed %", "stated %", "0.1° noticed %", "stated %")
    return text + "\n\n" + table(("views", "mount", "false alarms %", *noticed), rows)


def _row(views: int, mount: Mount, count: int) -> list[object]:
    sets = [_planned(views, seed, mount) for seed in range(SETS)]
    quiet = _checks(sets, mount, count, 0.0, 0.0, 1)
    shifted = _checks(sets, mount, count, SHIFT_M, 0.0, 2)
    turned = _checks(sets, mount, count, 0.0, TURN_RAD, 3)
    return [
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


def _checks(
    sets: list[_Set],
    mount: Mount,
    count: int,
    shift_m: float,
    turn_rad: float,
    seed: int,
) -> list[DriftCheck]:
    rng = np.random.default_rng([seed, len(sets[0].seen)])
    root = np.linalg.cholesky(COVARIANCE)
    found = []
    for trial in range(count):
        way = rng.normal(size=(2, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        poses = sets[trial % len(sets)]
        moved = perturb(poses.X, np.r_[way[0] * shift_m, way[1] * turn_rad])
        installed = perturb(poses.X, root @ rng.normal(size=6))
        new = _views(poses, mount, moved, rng)
        found.append(judge_shift(new, installed, COVARIANCE, NOISE))
    return found


def _views(poses: _Set, mount: Mount, X: Array, rng: np.random.Generator) -> ViewSet:
    """New views of a cell whose camera is truly at X."""
    points, found = board_points(_BOARD), []
    for k, seen in enumerate(poses.seen):
        error = np.r_[rng.normal(size=3) * NOISE.robot_m, rng.normal(size=3) * NOISE.robot_rad]
        pixels = project_at(_CAMERA, seen, points) + rng.normal(size=(len(points), 2)) * NOISE.corner_px
        found.append(BoardView(k, str(k), perturb(_flange(seen, mount, X, poses.Y), error), points, pixels))
    return solve_pnp(ViewSet(mount, tuple(found), _CAMERA), _BOARD)


def _flange(seen: Array, mount: Mount, X: Array, Y: Array) -> Array:
    return Y @ inverse(X @ seen) if mount == "eye-in-hand" else X @ seen @ inverse(Y)
