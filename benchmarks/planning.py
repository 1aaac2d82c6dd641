"""Are planned poses worth it? Error of X, its prediction, safety, time, and plans from a bad first guess.

Cells come from `random_cells`, every check of a plan too. X is estimated by the product's own
maximum-likelihood estimate with the lens free, from simulated corners and robot poses at mid noise (0.2 px,
0.3 mm, 0.03°).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import msgspec
import numpy as np

from benchmarks.random_cells import ARM, CAMERA, POINTS, RandomCell, is_free, random_cell, shows_board
from benchmarks.scene import MID
from benchmarks.trials import percentiles, rms, rms_spread, table, trials
from calibrate.estimate import estimate
from calibrate.geometry import Array, difference, perturb, pose, rotation_exp
from calibrate.information import Noise
from calibrate.kinematics import forward
from calibrate.likelihood.model import Observations, State
from calibrate.projection import project
from station.errors import LimitError
from station.limits import allowed_speed, check_plan, sample_path
from station.plan.bootstrap import Glimpse, improved_config, next_move
from station.plan.choose import choose, informations, objective_for
from station.plan.model import Plan
from station.plan.planner import PlanOptions, candidate_pool, plan_scene
from station.plan.scene import Scene, scene_of
from station.plan.view_range import ViewRange
from station.simulation.placement import guess_of

CELLS = 200
NOISE = Noise(MID.corner_px, MID.robot_m, MID.robot_rad)
MODERATE = ViewRange((0.38, 0.60), (0.0, np.deg2rad(30)), roll_rad=np.pi / 4, doubt=0.0)
WIDE = ViewRange((0.34, 0.75), (0.0, np.deg2rad(50)), roll_rad=np.pi / 2, off_centre=0.8, doubt=0.0)
RANDOM_ORDERS = 3
VISITS = 12
"""How often each set of poses is visited, with new noise; random poses are drawn anew for each visit."""


@dataclass
class Tally:
    """What all cells add up to."""

    errors: dict[str, list[Array]] = field(default_factory=dict)
    """Name → per cell the X errors (VISITS, 6)"""
    predicted: list[float] = field(default_factory=list)
    achieved: list[float] = field(default_factory=list)
    asked: int = 0
    planned: int = 0
    unseen: int = 0
    moves: int = 0
    colliding: int = 0
    narrow: int = 0
    seconds: list[float] = field(default_factory=list)
    motion: list[float] = field(default_factory=list)
    motion_random: list[float] = field(default_factory=list)
    boot_asked: int = 0
    bootstrapped: int = 0
    boot_moves: list[int] = field(default_factory=list)
    boot_unseen: int = 0
    failures: list[str] = field(default_factory=list)
    drawn: int = 0


def run() -> str:
    tally = Tally()
    for seed in range(trials(CELLS)):
        measure(tally, seed)
        if seed % 20 == 19:
            print(f"{seed + 1} cells: {tally.planned} planned, {tally.bootstrapped} bootstrapped", flush=True)
    return report(tally)


def measure(tally: Tally, seed: int) -> None:
    """Everything there is to measure on one cell."""
    cell, drawn = random_cell(seed)
    tally.drawn += drawn
    rng = np.random.default_rng([32, seed])
    _compare_choices(cell, tally, rng, seed)
    _plan_and_check(cell, tally, rng, seed)
    _bootstrap(cell, tally, rng, seed)


def _compare_choices(cell: RandomCell, tally: Tally, rng: np.random.Generator, seed: int) -> None:
    """Planned against random poses of one pool; the pool is of poses that truly see the board."""
    scene = scene_of(cell.exact())
    for name, view in (("moderate", MODERATE), ("wide", WIDE)):
        options = PlanOptions(seed=seed, noise=NOISE, view=view)
        pool, _ = candidate_pool(scene, options, cell.start, rng)
        each = informations(scene, pool.base_from_flange, NOISE, True)
        objective = objective_for(scene, "A", True)
        for label, sets in (
            (f"{name} planned 25", [choose(each, 25, objective, rng)] * VISITS),
            (f"{name} planned 12", [choose(each, 12, objective, rng)] * VISITS),
            (f"{name} random 25", [rng.permutation(len(pool))[:25].tolist() for _ in range(VISITS)]),
        ):
            visits = [_x_error(cell, pool.base_from_flange[places], rng) for places in sets]
            tally.errors.setdefault(label, []).append(np.array(visits))


def _plan_and_check(cell: RandomCell, tally: Tally, rng: np.random.Generator, seed: int) -> None:
    scene = scene_of(cell.config)
    begin = time.perf_counter()
    tally.asked += 1
    try:
        plan = plan_scene(scene, PlanOptions(seed=seed, noise=NOISE), cell.start.tolist())
    except LimitError as error:
        tally.failures.append(f"cell {seed}: {error}")
        return
    tally.seconds.append(time.perf_counter() - begin)
    tally.planned += len(plan.poses) == 25
    joints = np.array([cell.start, *(p.joints_rad for p in plan.poses)])
    for a, b in pairwise(joints):
        _check_path(a, b, cell, tally)
    flange = forward(ARM, joints[1:])
    tally.unseen += sum(not shows_board(cell.camera_from_board(E)) for E in flange)
    tally.motion.append(check_plan(plan, cell.start, scene.geometry).duration_s)
    tally.motion_random += [_random_time(scene, plan, cell, rng) for _ in range(RANDOM_ORDERS)]
    last = plan.poses[-1].predicted_sigma_m
    assert last is not None
    tally.predicted += [last] * VISITS
    tally.achieved += [float(np.linalg.norm(_x_error(cell, flange, rng)[:3])) for _ in range(VISITS)]


def _check_path(start: Array, target: Array, cell: RandomCell, tally: Tally) -> None:
    """200 postures along the move, against the true board and camera, which the planner only guessed."""
    path = start + np.linspace(0, 1, 200)[:, None] * (target - start)
    tally.moves += 1
    tally.colliding += not is_free(path, cell.X, cell.Y, 0.0, clearance=0.5).all()
    tally.narrow += not is_free(path, cell.X, cell.Y, 0.0).all()


def _random_time(scene: Scene, plan: Plan, cell: RandomCell, rng: np.random.Generator) -> float:
    """Motion time of the same poses in random order, each move as fast as its limits allow."""
    order = rng.permutation(len(plan.poses))
    joints = [cell.start, *(np.array(plan.poses[i].joints_rad) for i in order)]
    moves = pairwise(joints)
    return sum(allowed_speed(scene.geometry, sample_path(scene.geometry, a, b, 0.02))[2] for a, b in moves)


def _x_error(cell: RandomCell, flange: Array, rng: np.random.Generator) -> Array:
    """Error (6,) of the estimate from one noisy visit to these flange poses (n, 4, 4)."""
    n, k = len(flange), len(POINTS)
    there = perturb(flange, rng.normal(size=(n, 6)) * np.repeat([NOISE.robot_m, NOISE.robot_rad], 3))
    C = cell.camera_from_board(there)
    points = np.einsum("nij,kj->nki", C[:, :3, :3], POINTS) + C[:, None, :3, 3]
    pixels = project(CAMERA, points).pixels + rng.normal(0, NOISE.pixel_px, (n, k, 2))
    observed = Observations(
        "eye-in-hand", flange, np.broadcast_to(POINTS, (n, k, 3)), pixels, np.ones((n, k))
    )
    # From the pictures, as in a real solve: starting where the arm says would set its noise to zero at first.
    first = np.array([_board_pose(corners) for corners in pixels])
    found = estimate(observed, State(cell.X, cell.Y, first, CAMERA, np.zeros(0)), intrinsics_free=True)
    return difference(found.state.X, cell.X)


def _board_pose(pixels: Array) -> Array:
    """camera_from_board of one picture's corners (k, 2)."""
    lens = np.array(CAMERA.matrix), np.array(CAMERA.distortion)
    _, rotvec, translation = cv2.solvePnP(POINTS, pixels, *lens)
    return pose(rotation_exp(rotvec.ravel()), translation.ravel())


def _bootstrap(cell: RandomCell, tally: Tally, rng: np.random.Generator, seed: int) -> None:
    """From a mount guess wrong by 30° and 100 mm and no idea of the board's place."""

    def unit() -> Array:
        v = rng.normal(size=3)
        return np.asarray(v / np.linalg.norm(v))

    wrong = pose(rotation_exp(unit() * np.deg2rad(30)) @ cell.X[:3, :3], cell.X[:3, 3] + 0.1 * unit())
    config = msgspec.structs.replace(cell.config, camera_guess=guess_of(wrong, 0.06, 0.3), board_guess=None)

    def glimpse(joints: Sequence[float]) -> Glimpse:
        C = cell.camera_from_board(forward(ARM, joints))
        tally.boot_unseen += not shows_board(C)
        seen = perturb(C, rng.normal(size=6) * np.repeat([4e-4, 8e-4], 3))
        return Glimpse(np.array(joints), seen)

    glimpses = [glimpse(cell.start.tolist())]
    tally.boot_asked += 1
    try:
        while (move := next_move(config, glimpses)) is not None:
            _check_path(glimpses[-1].joints_rad, np.array(move.joints_rad), cell, tally)
            glimpses.append(glimpse(move.joints_rad))
        scene = scene_of(improved_config(config, glimpses))
        plan = plan_scene(scene, PlanOptions(seed=seed, noise=NOISE), glimpses[-1].joints_rad.tolist())
    except LimitError as error:
        tally.failures.append(f"bootstrap of cell {seed}: {error}")
        return
    tally.bootstrapped += len(plan.poses) == 25
    tally.boot_moves.append(len(glimpses) - 1)
    tally.boot_unseen += sum(
        not shows_board(cell.camera_from_board(forward(ARM, p.joints_rad))) for p in plan.poses
    )


def _error_rows(tally: Tally) -> list[list[str]]:
    """Translation and rotation of X, planned against random; spreads over the cells."""
    rows = []
    for pool, goals in (("moderate", ("0.70", "1.0")), ("wide", ("0.78", "1.0"))):
        mm, deg = _squares(tally, f"{pool} random 25")
        rows.append([pool, "random 25", _root(mm), "1", "", _root(deg), "1"])
        for number, goal in zip((25, 12), goals, strict=True):
            my_mm, my_deg = _squares(tally, f"{pool} planned {number}")
            rows.append([pool, f"planned {number}", _root(my_mm), _ratio(my_mm, mm), f"≤ {goal}"])
            rows[-1] += [_root(my_deg), _ratio(my_deg, deg)]
    return rows


def _squares(tally: Tally, name: str) -> tuple[Array, Array]:
    """Mean squared errors of X per cell: mm² and degrees², (cells,) each."""
    square = (np.array(tally.errors[name]) ** 2).mean(axis=1)
    return 1e6 * square[:, :3].sum(axis=1), np.rad2deg(1) ** 2 * square[:, 3:].sum(axis=1)


def _root(square: Array) -> str:
    return f"{np.sqrt(square.mean()):.3g}"


def _ratio(mine: Array, base: Array) -> str:
    """Root of the ratio of sums, ± its standard error with the cell as the unit (delta method)."""
    ratio = np.sqrt(mine.sum() / base.sum())
    spread = np.std(mine - ratio**2 * base) * np.sqrt(len(mine)) / base.sum() / (2 * ratio)
    return f"{ratio:.3f} ± {spread:.3f}"


def report(tally: Tally) -> str:
    ratio = (np.array(tally.achieved) / tally.predicted).reshape(-1, VISITS)
    by_cell = np.sqrt((ratio**2).mean(axis=1))
    facts = [
        ["full plan of 25", f"{tally.planned} of {tally.asked}", "≥ 99 %"],
        [
            "planned poses from which the true camera misses a corner",
            f"{tally.unseen} of {25 * tally.planned}",
            "",
        ],
        [
            "moves, plan and bootstrap, that touch something or halve the wanted clearance to table or board",
            f"{tally.colliding} of {tally.moves}",
            "0",
        ],
        ["moves that come nearer than the wanted clearance", f"{tally.narrow} of {tally.moves}", ""],
        ["planning, s", f"{percentiles(np.array(tally.seconds))}, most {max(tally.seconds):.1f}", "≤ 20"],
        ["arm motion, s", percentiles(np.array(tally.motion)), ""],
        [
            "motion time / random order",
            f"{np.mean(tally.motion) / np.mean(tally.motion_random):.3f}",
            "≤ 0.6",
        ],
        [
            "predicted / achieved sigma, pooled",
            f"{1 / rms(ratio):.3f} ± {rms_spread(by_cell) / rms(ratio) ** 2:.3f}",
            "0.9-1.1",
        ],
        [
            "full plan from a guess wrong by 30°, 100 mm",
            f"{tally.bootstrapped} of {tally.boot_asked}",
            "≥ 99 %",
        ],
        ["bootstrap moves", percentiles(np.array(tally.boot_moves)), "3-5"],
        ["bootstrap and its plan: views without the whole board", str(tally.boot_unseen), ""],
    ]
    text = (
        f"{tally.asked} random cells ({tally.drawn} drawn; the rest has no room by an independent check), "
        f"{VISITS} visits with new noise per cell to each kind of pose set; random poses drawn anew for each "
        "visit. ± is over the cells. Errors are of X, root mean square.\n\n"
    )
    heads = ["pool", "poses", "translation, mm", "ratio", "goal", "rotation, °", "ratio"]
    text += table(heads, _error_rows(tally)) + "\n\n"
    text += table(["what", "measured", "goal"], facts)
    return text + ("\n\nFailures: " + "; ".join(tally.failures) if tally.failures else "")
