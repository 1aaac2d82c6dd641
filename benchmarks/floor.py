"""How near the Cramér-Rao bound is the final estimate, and does its 95 % ellipsoid hold the truth?

The estimator is the product's (`calibrate.estimate`), noise scales estimated in every trial. It starts from
board poses by least squares and the pair objective's closed form. Where K comes from the same pictures it
starts from intrinsics wrong by 1 %: the optimum does not depend on the start, and Zhang's takes long.
"""

from __future__ import annotations

import numpy as np

from benchmarks.scene import LEVELS, Cell, Noise, make_cell
from benchmarks.trials import rms, rms_spread, share_spread, table, trials
from calibrate.assess import board_places, mean_pose
from calibrate.board_poses import refine_board_poses
from calibrate.estimate import Estimate, estimate
from calibrate.geometry import Array, difference, pose
from calibrate.likelihood.model import State, observe_views
from calibrate.likelihood.residuals import linearise
from calibrate.objective import build_objective
from calibrate.pairs import all_pairs
from calibrate.projection import intrinsics_vector, with_intrinsics_vector

COUNTS = (8, 15, 25, 50)
TRIALS = 2000


def run() -> str:
    count = trials(TRIALS)
    rows = []
    for level, noise in LEVELS.items():
        for free in (False, True):
            for views in COUNTS:
                rows.append(_row(level, noise, free, views, count))
                print(" | ".join(rows[-1]), flush=True)
    header = [
        "noise",
        "K",
        "views",
        "rms mm",
        "rms °",
        "/ bound, translation",
        "/ bound, rotation",
        "coverage %",
    ]
    text = (
        f"{count} trials per row, each a new scene (paper's cell); ± is one standard error. Bound: root of "
        "the trace of the inverse Fisher information at the truth with the true noise scales, which the "
        "estimator is not told. Noise (corner px, robot mm, robot °): low 0.1/0.05/0.005, mid 0.2/0.3/0.03, "
        "high 0.5/1/0.1."
    )
    return text + "\n\n" + table(header, rows)


def _row(level: str, noise: Noise, free: bool, views: int, count: int) -> list[str]:
    rng = np.random.default_rng([views, int(free), list(LEVELS).index(level)])
    errors, bounds, inside = np.zeros((count, 2)), np.zeros((count, 2)), 0
    for k in range(count):
        cell = make_cell(rng, views, noise, with_pnp=False)
        fisher = bound(cell, noise, free)
        result = solve(cell, free, rng)
        delta = difference(result.state.X, cell.X)
        errors[k] = np.linalg.norm(delta[:3]), np.linalg.norm(delta[3:])
        bounds[k] = np.trace(fisher[:3, :3]), np.trace(fisher[3:, 3:])
        inside += bool(delta @ np.linalg.solve(result.covariance, delta) <= result.threshold)
    floor = np.sqrt(bounds.mean(axis=0))
    share = inside / count
    ratio = [
        f"{rms(errors[:, i]) / floor[i]:.3f} ± {rms_spread(errors[:, i]) / floor[i]:.3f}" for i in (0, 1)
    ]
    return [
        level,
        "same pictures" if free else "known",
        str(views),
        f"{1e3 * rms(errors[:, 0]):.3f}",
        f"{np.degrees(rms(errors[:, 1])):.4f}",
        *ratio,
        f"{100 * share:.1f} ± {100 * share_spread(share, count):.1f}",
    ]


def bound(cell: Cell, noise: Noise, free: bool) -> Array:
    """(6, 6) inverse Fisher information of X at the truth."""
    observed = observe_views(cell.views)
    truth = State(cell.X, cell.Y, cell.C, cell.camera, np.zeros(0))
    precision = np.array([noise.corner_px, noise.robot_m, noise.robot_rad, 1.0]) ** -2
    return linearise(observed, truth, observed.present, free).solve(precision).covariance[:6, :6]


def solve(cell: Cell, free: bool, rng: np.random.Generator) -> Estimate:
    observed, camera = observe_views(cell.views), cell.camera
    if free:
        vector = intrinsics_vector(camera)
        vector[:4] *= 1 + 0.01 * rng.uniform(-1, 1, 4)
        camera = with_intrinsics_vector(camera, vector)
    start = State(np.eye(4), np.eye(4), cell.C, camera, np.zeros(0))
    C = refine_board_poses(observed, start).C
    H = cell.views.base_from_flange
    objective = build_objective(all_pairs(H, C))
    X = pose(objective.R0, objective.b0)
    return estimate(observed, State(X, mean_pose(board_places(H, C, X)), C, camera, np.zeros(0)), free)
