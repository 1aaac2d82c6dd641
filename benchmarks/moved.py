"""Whether "the board moved" is true: arms whose errors follow their posture, and real moves half-way.

Cells of `tests.calibrate.chains`, with eccentric encoders beside the errors of the links.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.trials import rows_of, table, trials
from calibrate.errors import CalibrationError
from calibrate.handeye.solution import Reading, SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.lens.pnp import solve_pnp
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, pose
from recordings.schema.messages import Mount
from tests.calibrate.chains import CAMERA, arm_cell, in_sight, views_at

TRIALS = 40
_VIEWS = 25
_OPTIONS = SolveOptions(holdout=False, folds=False)
_ARMS = ("ur", "spherical wrist", "60° wrist", "seven joints")
_SIZES_MM = (0.2, 0.5)
_NEAR = 2
"""Views by which the first changed view may be missed."""
MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
ORDERS = ("random", "swept", "halves")
WHAT = {"nothing": Reading.AS_RECORDED, "board": Reading.BOARD_MOVED, "camera": Reading.CAMERA_MOVED}
_CHANGES = (Reading.BOARD_MOVED, Reading.CAMERA_MOVED, Reading.REFOCUSED)
HEADER = ("what moved", "mm", "order of the postures", "joints told", "mount", "cells", "a change is named %",
          "the true one, within 2 views %", "true view within the range told %")  # fmt: skip


@dataclass(frozen=True)
class MovedTrial:
    named: bool
    """That something changed."""
    truly: bool
    """What moved, and its first view within `_NEAR`."""
    held: bool
    """The range that was told holds the first view."""


def run() -> str:
    count = trials(TRIALS)
    cases = [
        (what, 0.0 if what == "nothing" else 1.0, order, joints, mount)
        for what in WHAT
        for order in (ORDERS if what == "nothing" else ("random", "swept"))
        for joints in (False, True)
        for mount in MOUNTS
    ]
    rows = rows_of(measure, cases, count, line)
    low, high = _SIZES_MM
    text = (
        f"{count} cells per row, {_VIEWS} views, arms of {len(_ARMS)} kinds in turn. Each link is off by "
        f"{low} … {high} mm and mrad (1σ in each direction), each encoder is eccentric by half of that; "
        "corners .15 px, robot noise .02 mm. Swept: the postures in the order of their main direction. "
        "Halves: first those of one side, then those of the other, so that all errors of the arm change at "
        "the middle. What moves is shifted by 1 mm in any direction before one of the views 10 to 17."
    )
    return text + "\n\n" + table(HEADER, rows)


def measure(task: tuple[str, float, str, bool, Mount, int]) -> MovedTrial:
    what, size_mm, order, joints, mount, seed = task
    rng = np.random.default_rng([52, seed, joints, *what.encode(), *order.encode(), *mount.encode()])
    at = int(rng.integers(9, 17))
    views = moved_cell(rng, what, size_mm, order, joints, mount, at, seed)
    try:
        session = solve_views(views, _OPTIONS).judgement.session
    except CalibrationError as problem:
        named = problem.values.get("hypothesis") in {reading.value for reading in _CHANGES}
        return MovedTrial(named, False, False)
    named = session.reading in _CHANGES
    truly = session.reading is WHAT[what] and (not named or abs(session.at - at) <= _NEAR)
    first, last = session.between
    return MovedTrial(named, truly, named and first <= at <= last)


def moved_cell(
    rng: np.random.Generator,
    what: str,
    size_mm: float,
    order: str,
    joints: bool,
    mount: Mount,
    at: int,
    seed: int,
    views: int = _VIEWS,
) -> ViewSet:
    """Views of a cell in which `what` is shifted by `size_mm` before view `at`."""
    size = rng.uniform(*_SIZES_MM)
    cell = arm_cell(_ARMS[seed % len(_ARMS)], mount, round(size, 3), seed, 4, joints)
    q = _ordered(in_sight(cell.arm, mount, cell.X, cell.Y, rng, views), order, rng)
    eccentric = 0.5e-3 * size * rng.normal(size=q.shape[1])
    phase = rng.uniform(0, 2 * np.pi, q.shape[1])
    shift = rng.normal(size=3)
    shifted = pose(np.eye(3), 1e-3 * size_mm * shift / np.linalg.norm(shift))
    X = shifted @ cell.X if what == "camera" else cell.X
    Y = shifted @ cell.Y if what == "board" else cell.Y
    true = q + eccentric * np.sin(q + phase)
    parts = [
        views_at(cell.arm, mount, *places, cell.link_errors, rng, angles)
        for places, angles in (((cell.X, cell.Y), true[:at]), ((X, Y), true[at:]))
    ]
    told = cell.arm.forward(q)
    seen = [
        replace(
            view,
            index=i,
            name=f"view {i}",
            base_from_flange=told[i],
            joints_rad=q[i] if joints else None,
        )
        for i, view in enumerate([*parts[0].views, *parts[1].views])
    ]
    return solve_pnp(ViewSet(mount, tuple(seen), CAMERA))


def _ordered(q: Array, order: str, rng: np.random.Generator) -> Array:
    if order == "random":
        return q
    away = q - q.mean(axis=0)
    along = np.argsort(away @ np.linalg.svd(away, full_matrices=False)[2][0])
    if order == "halves":
        half = len(q) // 2
        along = np.concatenate([rng.permutation(along[:half]), rng.permutation(along[half:])])
    return np.asarray(q[along])


def line(case: tuple[str, float, str, bool, Mount], found: list[MovedTrial]) -> list[str]:
    what, size_mm, order, joints, mount = case
    named = [trial for trial in found if trial.named]

    def percent(count: int, of: int) -> str:
        return f"{100 * count / of:.1f}" if of else "-"

    return [
        what,
        f"{size_mm:g}",
        order,
        "yes" if joints else "no",
        mount,
        str(len(found)),
        percent(len(named), len(found)),
        percent(sum(trial.truly for trial in found), len(found)),
        percent(sum(trial.held for trial in named), len(named)),
    ]
