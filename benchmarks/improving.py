"""Gain of replanning the remaining poses after eight images.

Random cells of `random_cells` with guesses wrong by their sigmas; a plan of 25 is made from the guess, eight
of its poses are visited with mid noise, and the rest is planned anew from what these pictures show
(`station.analysis.improvement`). Both are then visited with new noise and estimated as `planning` does it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import msgspec
import numpy as np

from benchmarks.planning import NOISE, x_error
from benchmarks.random_cells import ARM, CAMERA, POINTS, RandomCell, random_cell, roughly, shows_board
from benchmarks.trials import percentiles, table, trials
from calibrate.errors import CalibrationError
from calibrate.geometry import Array, perturb, transform_points
from calibrate.kinematics import forward
from calibrate.projection import project
from station.analysis.improvement import improve
from station.analysis.worker import CapturedView
from station.cell.errors import StationError
from station.cell.plan import Plan
from station.cell.scene import scene_of
from station.plan.planner import PlanOptions, plan_scene

CELLS = 40
FIRST = 8
VISITS = 5
GUESSES = ((0.005, 0.03), (0.02, 0.1))
"""Metres and radians, per axis."""


@dataclass(frozen=True)
class Result:
    squares: tuple[Array, Array]
    """Mean squared errors of X, translation (m²) and rotation (rad²): old plan, improved plan."""
    cut: tuple[int, int]
    margin_px: tuple[float, float]
    cpu_seconds: float


def run() -> str:
    rows, notes = [], []
    for guess in GUESSES:
        found, refused = [], []
        for seed in range(trials(CELLS)):
            name = f"cell {seed}, {1000 * guess[0]:.0f} mm"
            try:
                found.append(measure(seed, *guess))
            except (StationError, CalibrationError) as error:
                refused.append(f"{name}: {error}")
            print(name, found[-1:], refused[-1:], flush=True)
        rows += _rows(guess, found)
        notes += refused
    heads = ["guess", "cells", "plan", "translation, mm", "ratio", "rotation, °", "ratio"]
    heads += ["poses that cut the board", "empty strip along the edges, px"]
    text = table(heads, rows) + f"\n\n{VISITS} visits to each plan; ± is over the cells."
    return text + ("\n\nNot improved: " + "; ".join(notes) if notes else "")


def measure(seed: int, guess_m: float, guess_rad: float) -> Result:
    """StationError without a first plan or an improvement, CalibrationError when too many boards are cut."""
    cell, _ = random_cell(seed)
    rng = np.random.default_rng([40, seed])
    guesses = {
        "camera_guess": roughly(cell.X, rng, guess_m, guess_rad),
        "board_guess": roughly(cell.Y, rng, guess_m, guess_rad),
    }
    config = msgspec.structs.replace(cell.config, **guesses)
    plan = plan_scene(scene_of(config), PlanOptions(seed=seed), cell.start.tolist())
    flange = _flange(plan)
    seen = [_picture(cell, index, flange[index], rng) for index in range(FIRST)]
    left = msgspec.structs.replace(plan, poses=plan.poses[FIRST:])
    begin = time.process_time()
    found = improve(config, False, seen, left, plan.poses[FIRST - 1].joints_rad, seed)
    seconds = time.process_time() - begin
    better = np.concatenate([flange[:FIRST], _flange(found.plan)])
    old, new = (_errors(cell, poses, rng) for poses in (flange, better))
    cut = tuple(sum(not shows_board(cell.camera_from_board(E)) for E in poses) for poses in (flange, better))
    return Result((old, new), (cut[0], cut[1]), (_margin(cell, flange), _margin(cell, better)), seconds)


def _flange(plan: Plan) -> Array:
    return forward(ARM, np.array([pose.joints_rad for pose in plan.poses]))


def _picture(cell: RandomCell, index: int, flange: Array, rng: np.random.Generator) -> CapturedView:
    """Corners outside the picture are not seen."""
    there = perturb(flange, rng.normal(size=6) * np.repeat([NOISE.robot_m, NOISE.robot_rad], 3))
    pixels = project(CAMERA, transform_points(cell.camera_from_board(there), POINTS)).pixels
    pixels = pixels + rng.normal(0, NOISE.pixel_px, pixels.shape)
    inside = ((pixels > 2) & (pixels < [CAMERA.width - 3, CAMERA.height - 3])).all(axis=1)
    return CapturedView(index, flange, np.flatnonzero(inside), pixels[inside])


def _errors(cell: RandomCell, flange: Array, rng: np.random.Generator) -> Array:
    """Mean squares (2,) of X over the visits; a pose that cuts the board gives no view."""
    whole = np.array([E for E in flange if shows_board(cell.camera_from_board(E))])
    errors = np.array([x_error(cell, whole, rng) for _ in range(VISITS)])
    return np.array([(errors[:, part] ** 2).sum(axis=1).mean() for part in (slice(0, 3), slice(3, 6))])


def _margin(cell: RandomCell, flange: Array) -> float:
    """Widest strip along an edge of the picture that no corner comes into."""
    C = np.array([C for C in cell.camera_from_board(flange) if shows_board(C)])
    pixels = project(CAMERA, transform_points(C, POINTS)).pixels.reshape(-1, 2)
    size = np.array([CAMERA.width, CAMERA.height]) - 1
    return float(max(pixels.min(axis=0).max(), (size - pixels.max(axis=0)).max()))


def _rows(guess: tuple[float, float], found: list[Result]) -> list[list[str]]:
    rows = []
    base = np.array([result.squares[0] for result in found])
    for plan, name in enumerate(("as first planned", "improved after 8")):
        mine = np.array([result.squares[plan] for result in found])
        row = [f"{1000 * guess[0]:.0f} mm, {guess[1]:g} rad", str(len(found)), name]
        for part, unit in ((0, 1e3), (1, np.rad2deg(1.0))):
            ratio = np.sqrt(mine[:, part].sum() / base[:, part].sum())
            spread = np.std(mine[:, part] - ratio**2 * base[:, part]) * np.sqrt(len(found))
            error = spread / base[:, part].sum() / (2 * ratio)
            told = f"{ratio:.3f} ± {error:.3f}" if plan else "1"
            row += [f"{unit * np.sqrt(mine[:, part].mean()):.3g}", told]
        cut = sum(result.cut[plan] for result in found)
        margin = percentiles(np.array([result.margin_px[plan] for result in found]))
        rows.append([*row, f"{cut} of {25 * len(found)}", margin])
    return rows
