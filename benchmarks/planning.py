"""Planned poses: error of X, its prediction, safety and time.

Cells come from `random_cells`, every check of a plan too. X is estimated by the product's own
estimate with the lens free, from simulated corners and robot poses at mid noise (0.2 px,
0.3 mm, 0.03°).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from benchmarks.random_cells import (
    ARM,
    CAMERA,
    CLEARANCES_M,
    POINTS,
    RandomCell,
    gaps,
    random_cell,
    shows_board,
)
from benchmarks.scene import MID
from benchmarks.trials import percentiles, rms, rms_spread, table, trials
from calibrate.arms.kinematics import forward
from calibrate.handeye.cell_state import CellState
from calibrate.handeye.estimate import estimate
from calibrate.handeye.priors import LensPrior, Priors
from calibrate.handeye.reprojection import bent_points
from calibrate.results import SHAPE
from calibrate.views.projection import project
from calibrate.views.view_set import Observations, extent_of
from recordings.geometry import Array, difference, perturb
from station.cell.errors import LimitError
from station.cell.layout import layout_of
from station.cell.limits import check_plan
from station.plan.choose import camera_objective, choose, informations
from station.plan.planner import PlanOptions, candidate_pool, plan_layout
from station.plan.visibility import ViewRange

CELLS = 200
MODERATE = ViewRange((0.38, 0.60), (0.0, np.deg2rad(30)), roll_rad=np.pi / 4, doubt=0.0)
WIDE = ViewRange((0.34, 0.75), (0.0, np.deg2rad(50)), roll_rad=np.pi / 2, off_centre=0.8, doubt=0.0)
AHEAD_M = 0.5
_PRIORS = Priors(LensPrior.unknown(CAMERA))
VISITS = 5
"""Visits of each set of poses, with new noise; random poses are drawn anew for each visit."""


@dataclass
class CellResult:
    """Figures of one cell."""

    seed: int
    drawn: int
    """Cells drawn until one was reasonable"""
    squares: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """Mean squared errors of X by set of poses: translation mm², rotation degrees², a point ahead mm²"""
    achieved: list[float] = field(default_factory=list)
    """Errors of a point at the working distance by those of X, over the predicted part by X"""
    planned: bool = False
    unseen: int = 0
    moves: int = 0
    colliding: int = 0
    cpu_s: float = 0.0
    failures: list[str] = field(default_factory=list)


def run() -> str:
    return report([measure(seed) for seed in range(trials(CELLS))])


def measure(seed: int) -> CellResult:
    """Everything there is to measure on one cell."""
    cell, drawn = random_cell(seed)
    result = CellResult(seed, drawn)
    rng = np.random.default_rng([32, seed])
    _compare_choices(cell, result, rng, seed)
    _plan_and_check(cell, result, rng, seed)
    return result


def _compare_choices(cell: RandomCell, result: CellResult, rng: np.random.Generator, seed: int) -> None:
    """Planned against random poses of one pool; the pool is of poses that truly see the board."""
    scene = layout_of(cell.exact())
    for name, view in (("moderate", MODERATE), ("wide", WIDE)):
        options = PlanOptions(seed=seed, noise=MID, view=view)
        pool, _ = candidate_pool(scene, options, cell.start, rng)
        each = informations(scene, pool.base_from_flange, noise=MID)
        objective = camera_objective(scene.camera, scene.board, scene.working_distance_m, True)
        for label, sets in (
            (f"{name} planned 25", [choose(each, 25, objective, rng)] * VISITS),
            (f"{name} random 25", [rng.permutation(len(pool))[:25].tolist() for _ in range(VISITS)]),
        ):
            visits = [x_error(cell, pool.base_from_flange[places], rng) for places in sets]
            result.squares[label] = _squares(np.array(visits), cell.X)


def _squares(errors: Array, X: Array) -> tuple[float, float, float]:
    """Mean squared errors of X (visits, 6): translation, rotation, and of a point ahead of the camera."""
    scaled = (1e3 * errors[:, :3], np.rad2deg(errors[:, 3:]), 1e3 * _ahead(errors, X, AHEAD_M))
    mm, deg, point = (float((e**2).sum(axis=1).mean()) for e in scaled)
    return mm, deg, point


def _ahead(errors: Array, X: Array, distance_m: float) -> Array:
    """Errors (n, 3) of a point so far ahead of the camera, by those of X (n, 6)."""
    return errors[:, :3] + np.cross(errors[:, 3:], distance_m * X[:3, 2])


def _plan_and_check(cell: RandomCell, result: CellResult, rng: np.random.Generator, seed: int) -> None:
    # These arms have noise and no errors of links: what is predicted must be so, too.
    scene = replace(layout_of(cell.config), of_class=None)
    begin_s = time.process_time()
    try:
        plan = plan_layout(scene, PlanOptions(seed=seed, noise=MID), cell.start.tolist())
    except LimitError as error:
        result.failures.append(f"cell {seed}: {error}")
        return
    result.cpu_s = time.process_time() - begin_s
    result.planned = len(plan.poses) == 25
    joints = np.array([cell.start, *(p.joints_rad for p in plan.poses)])
    for a, b in pairwise(joints):
        _check_path(a, b, cell, result)
    flange = forward(ARM, joints[1:])
    result.unseen += sum(not shows_board(cell.camera_from_board(E)) for E in flange)
    check_plan(plan, cell.start, scene.geometry)
    last_m = plan.poses[-1].predicted_sigma_m
    distance_m = plan.working_distance_m
    assert last_m is not None and plan.floor_m is not None and distance_m is not None
    by_x_m = np.sqrt(last_m**2 - plan.floor_m**2)
    errors = np.array([x_error(cell, flange, rng) for _ in range(2 * VISITS)])
    result.achieved = [float(e / by_x_m) for e in np.linalg.norm(_ahead(errors, cell.X, distance_m), axis=1)]


def _check_path(start: Array, target: Array, cell: RandomCell, result: CellResult) -> None:
    """200 postures along the move, against the true board and camera, which the planner only guessed."""
    path = start + np.linspace(0, 1, 200)[:, None] * (target - start)
    result.moves += 1
    from_cell, itself = gaps(path, cell.X, cell.Y)
    result.colliding += bool(itself.min() < 0 or (from_cell < CLEARANCES_M / 2).any())


def x_error(cell: RandomCell, flange: Array, rng: np.random.Generator) -> Array:
    """Error (6,) of the estimate from one noisy visit to these flange poses (n, 4, 4).

    The board is a new one each time, off by its tolerance, which the prediction contains.
    """
    n, k = len(flange), len(POINTS)
    there = perturb(flange, rng.normal(size=(n, 6)) * np.repeat([MID.robot_m, MID.robot_rad], 3))
    C = cell.camera_from_board(there)
    observed = Observations(
        "eye-in-hand",
        flange,
        np.broadcast_to(POINTS, (n, k, 3)),
        np.zeros((n, k, 2)),
        np.ones((n, k)),
        np.zeros((n, 6, 0)),
        extent_of(POINTS),
    )
    board = bent_points(observed, rng.normal(size=len(SHAPE)) * _PRIORS.board.sigma)
    points = np.einsum("nij,nkj->nki", C[:, :3, :3], board) + C[:, None, :3, 3]
    pixels = project(CAMERA, points).pixels + rng.normal(0, MID.corner_px, (n, k, 2))
    # From where the boards truly were: starting where the arm says would set its noise to zero at first.
    start = CellState(cell.X, cell.Y, C, CAMERA, np.zeros(len(SHAPE)), np.zeros(0))
    found = estimate(replace(observed, pixels=pixels), start, _PRIORS)
    return difference(found.state.X, cell.X)


def report(cells: list[CellResult]) -> str:
    seen = f"{sum(c.drawn for c in cells)} drawn; the rest has no room by an independent check"
    text = (
        f"{len(cells)} random cells ({seen}), 5 visits with new noise per cell to each kind of pose set; "
        "random poses drawn anew for each visit. Root mean square errors of X; ± is over the cells. Point: "
        "the place in `flange` of a point that the camera sees 0.5 m ahead, where translation and rotation "
        "count as they do in use.\n\n"
    )
    heads = ["pool", "poses", "translation, mm", "ratio", "goal"]
    heads += ["rotation, °", "ratio", "point, mm", "ratio"]
    text += table(heads, _error_rows(cells)) + "\n\n" + table(["what", "measured", "goal"], _facts(cells))
    failures = [failure for cell in cells for failure in cell.failures]
    return text + ("\n\nFailures: " + "; ".join(failures) if failures else "")


def _error_rows(cells: list[CellResult]) -> list[list[str]]:
    """Planned against random; spreads over the cells."""
    rows = []
    for pool, goal in (("moderate", "0.70"), ("wide", "0.78")):
        base, mine = (_squares_of(cells, f"{pool} {kind} 25") for kind in ("random", "planned"))
        rows.append([pool, "random 25", _root(base[0]), "1", "", _root(base[1]), "1", _root(base[2]), "1"])
        row = [pool, "planned 25"]
        for squares, against in zip(mine, base, strict=True):
            row += [_root(squares), _ratio(squares, against)]
        rows.append([*row[:4], f"≤ {goal}", *row[4:]])
    return rows


def _squares_of(cells: list[CellResult], name: str) -> Array:
    """(3, cells): translation, rotation, point."""
    return np.array([cell.squares[name] for cell in cells if cell.squares]).T


def _root(square: Array) -> str:
    return f"{np.sqrt(square.mean()):.3g}"


def _ratio(mine: Array, base: Array) -> str:
    """Root of the ratio of sums, ± its standard error with the cell as the unit (delta method)."""
    ratio = np.sqrt(mine.sum() / base.sum())
    spread = np.std(mine - ratio**2 * base) * np.sqrt(len(mine)) / base.sum() / (2 * ratio)
    return f"{ratio:.3f} ± {spread:.3f}"


def _facts(cells: list[CellResult]) -> list[list[str]]:
    planned = [cell for cell in cells if cell.planned]
    by_cell = np.array([rms(np.array(cell.achieved)) for cell in planned])
    moves = sum(cell.moves for cell in cells)
    cpu_s = np.array([cell.cpu_s for cell in planned])
    ratio = rms(by_cell)
    return [
        ["full plan of 25", f"{len(planned)} of {len(cells)}", "≥ 99 %"],
        [
            "planned poses from which the true camera misses a corner",
            f"{sum(cell.unseen for cell in cells)} of {25 * len(planned)}",
            "0",
        ],
        [
            "moves that touch something or halve the wanted clearance to table or board",
            f"{sum(cell.colliding for cell in cells)} of {moves}",
            "0",
        ],
        ["planning, s of CPU", f"{percentiles(cpu_s)}, most {cpu_s.max():.1f}", "≤ 20"],
        [
            "predicted / achieved sigma, pooled",
            f"{1 / ratio:.3f} ± {rms_spread(by_cell) / ratio**2:.3f}",
            "0.9-1.1",
        ],
    ]
