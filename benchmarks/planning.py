"""Planned poses: error of X, its prediction, safety and time.

Cells come from `random_cells`, every check of a plan too. X is estimated by the product's own
estimate with the lens free, from simulated corners and robot poses at mid noise (0.2 px,
0.3 mm, 0.03°). PLANNING_LOG=FILE keeps each cell's results there, and a run that was stopped goes on.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.planning_report import CellResult, report
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
from benchmarks.trials import trials
from calibrate.geometry import Array, difference, perturb
from calibrate.handeye.cell_state import CellState
from calibrate.handeye.estimate import estimate
from calibrate.handeye.information import MeasurementNoise
from calibrate.handeye.priors import LensPrior, Priors
from calibrate.handeye.reprojection import bent_points
from calibrate.kinematics import forward
from calibrate.projection import project
from calibrate.results import SHAPE
from calibrate.views import Observations, extent_of
from station.cell.errors import LimitError
from station.cell.layout import CellLayout, layout_of
from station.cell.limits import allowed_speed, check_plan, sample_path
from station.cell.pose_plan import Plan
from station.plan.choose import choose, informations, objective_for
from station.plan.planner import PlanOptions, candidate_pool, plan_layout
from station.plan.visibility import ViewRange

CELLS = 200
NOISE = MeasurementNoise(MID.corner_px, MID.robot_m, MID.robot_rad)
MODERATE = ViewRange((0.38, 0.60), (0.0, np.deg2rad(30)), roll_rad=np.pi / 4, doubt=0.0)
WIDE = ViewRange((0.34, 0.75), (0.0, np.deg2rad(50)), roll_rad=np.pi / 2, off_centre=0.8, doubt=0.0)
AHEAD_M = 0.5
_PRIORS = Priors(LensPrior.unknown(CAMERA))
RANDOM_ORDERS = 3
VISITS = 5
"""Visits of each set of poses, with new noise; random poses are drawn anew for each visit."""


def run() -> str:
    kept = os.environ.get("PLANNING_LOG")
    log = Path(kept) if kept else None
    done = _earlier(log)
    for seed in range(trials(CELLS)):
        if seed in done:
            continue
        done[seed] = measure(seed)
        if log:
            with log.open("ab") as file:
                file.write(msgspec.json.encode(done[seed]) + b"\n")
        print(f"cell {seed}", flush=True)
    return report(list(done.values()))


def _earlier(log: Path | None) -> dict[int, CellResult]:
    if log is None or not log.exists():
        return {}
    lines = [line for line in log.read_bytes().split(b"\n") if line]
    found = (msgspec.json.decode(line, type=CellResult) for line in lines)
    return {result.seed: result for result in found}


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
        options = PlanOptions(seed=seed, noise=NOISE, view=view)
        pool, _ = candidate_pool(scene, options, cell.start, rng)
        each = informations(scene, pool.base_from_flange, noise=NOISE)
        objective = objective_for(scene, "A", True)
        for label, sets in (
            (f"{name} planned 25", [choose(each, 25, objective, rng)] * VISITS),
            (f"{name} planned 12", [choose(each, 12, objective, rng)] * VISITS),
            (f"{name} random 25", [rng.permutation(len(pool))[:25].tolist() for _ in range(VISITS)]),
        ):
            visits = [x_error(cell, pool.base_from_flange[places], rng) for places in sets]
            result.squares[label] = _squares(np.array(visits), cell.X)


def _squares(errors: Array, X: Array) -> tuple[float, float, float]:
    """Mean squared errors of X (visits, 6): translation, rotation, and of a point ahead of the camera."""
    ahead = errors[:, :3] + np.cross(errors[:, 3:], AHEAD_M * X[:3, 2])
    scaled = (1e3 * errors[:, :3], np.rad2deg(errors[:, 3:]), 1e3 * ahead)
    mm, deg, point = (float((e**2).sum(axis=1).mean()) for e in scaled)
    return mm, deg, point


def _plan_and_check(cell: RandomCell, result: CellResult, rng: np.random.Generator, seed: int) -> None:
    scene = layout_of(cell.config)
    begin, begin_cpu = time.perf_counter(), time.process_time()
    try:
        plan = plan_layout(scene, PlanOptions(seed=seed, noise=NOISE), cell.start.tolist())
    except LimitError as error:
        result.failures.append(f"cell {seed}: {error}")
        return
    result.seconds = time.perf_counter() - begin
    result.cpu_seconds = time.process_time() - begin_cpu
    result.planned = len(plan.poses) == 25
    joints = np.array([cell.start, *(p.joints_rad for p in plan.poses)])
    for a, b in pairwise(joints):
        _check_path(a, b, cell, result)
    flange = forward(ARM, joints[1:])
    result.unseen += sum(not shows_board(cell.camera_from_board(E)) for E in flange)
    result.motion_s = check_plan(plan, cell.start, scene.geometry).duration_s
    times = [_random_time(scene, plan, cell, rng) for _ in range(RANDOM_ORDERS)]
    result.motion_random_s = float(np.mean(times))
    last = plan.poses[-1].predicted_sigma_m
    assert last is not None
    errors = np.array([x_error(cell, flange, rng) for _ in range(2 * VISITS)])
    result.achieved = [float(e) / last for e in np.linalg.norm(errors[:, :3], axis=1)]


def _check_path(start: Array, target: Array, cell: RandomCell, result: CellResult) -> None:
    """200 postures along the move, against the true board and camera, which the planner only guessed."""
    path = start + np.linspace(0, 1, 200)[:, None] * (target - start)
    result.moves += 1
    from_cell, itself = gaps(path, cell.X, cell.Y)
    result.colliding += bool(itself.min() < 0 or (from_cell < CLEARANCES_M / 2).any())
    result.narrow += bool(itself.min() < 0 or (from_cell < CLEARANCES_M).any())


def _random_time(scene: CellLayout, plan: Plan, cell: RandomCell, rng: np.random.Generator) -> float:
    """Motion time of the same poses in random order, each move as fast as its limits allow."""
    order = rng.permutation(len(plan.poses))
    joints = [cell.start, *(np.array(plan.poses[i].joints_rad) for i in order)]
    moves = pairwise(joints)
    return sum(allowed_speed(scene.geometry, sample_path(scene.geometry, a, b, 0.02))[2] for a, b in moves)


def x_error(cell: RandomCell, flange: Array, rng: np.random.Generator) -> Array:
    """Error (6,) of the estimate from one noisy visit to these flange poses (n, 4, 4).

    The board is a new one each time, off by its tolerance, which the prediction contains.
    """
    n, k = len(flange), len(POINTS)
    there = perturb(flange, rng.normal(size=(n, 6)) * np.repeat([NOISE.robot_m, NOISE.robot_rad], 3))
    C = cell.camera_from_board(there)
    observed = Observations(
        "eye-in-hand",
        flange,
        np.broadcast_to(POINTS, (n, k, 3)),
        np.zeros((n, k, 2)),
        np.ones((n, k)),
        extent=extent_of(POINTS),
    )
    board = bent_points(observed, rng.normal(size=len(SHAPE)) * _PRIORS.board_sigma)
    points = np.einsum("nij,nkj->nki", C[:, :3, :3], board) + C[:, None, :3, 3]
    pixels = project(CAMERA, points).pixels + rng.normal(0, NOISE.pixel_px, (n, k, 2))
    # From where the boards truly were: starting where the arm says would set its noise to zero at first.
    start = CellState(cell.X, cell.Y, C, CAMERA, np.zeros(len(SHAPE)), np.zeros(0))
    found = estimate(replace(observed, pixels=pixels), start, _PRIORS)
    return difference(found.state.X, cell.X)
