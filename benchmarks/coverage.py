"""Coverage of the stated 95 % region where board, lens, arm or bracket are not as stated.

The whole way of `calibrate solve` after detection: lens, board poses, estimate, cross-validation, gates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.imperfect_cells import Imperfection, Known, imperfect_cell
from benchmarks.trials import Miss, rms, rows_of, table, trials
from calibrate.errors import CalibrationError
from calibrate.handeye.axxb.global_start import solve_global
from calibrate.handeye.axxb.pairs import all_pairs, mount_poses
from calibrate.handeye.solution import SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.lens.intrinsics import LensModel
from calibrate.pipeline.gates import judge
from calibrate.pipeline.job import single_threaded_opencv
from recordings.schema.messages import Mount

TRIALS = 200
_BEYOND = 3.0
"""Stated sigmas, of the length of the translation's or the rotation's error."""


_NOTHING, _UNKNOWN, _LENS = Imperfection(), Known(), Known(lens=True)


@dataclass(frozen=True)
class Row:
    name: str
    wrong: Imperfection = _NOTHING
    known: Known = _UNKNOWN
    model: LensModel = "plumb_bob"
    by_told_flanges: bool = False
    """Measured against the X that the told flanges imply (AX = XB, no noise), not that of a perfect arm."""


@dataclass(frozen=True)
class CoverageTrial:
    """One cell, solved and judged."""

    closed: tuple[str, ...]
    """Names of the closed gates; where nothing was solved: what was said instead."""
    miss: Miss | None = None
    """None where nothing was solved."""
    beyond: bool = False
    claimed_m: float = 0.0


ROWS = (
    Row("clean"),
    Row("clean, arm and joints known", known=Known(arm=True, joints=True)),
    Row("clean, lens given", known=_LENS),
    Row("size 0.2 %", Imperfection(size=0.002)),
    Row("size 0.5 %", Imperfection(size=0.005)),
    Row("bent 0.2 mm", Imperfection(bend_m=2e-4)),
    Row("bent 0.5 mm", Imperfection(bend_m=5e-4)),
    Row("x against y 0.5 %", Imperfection(unequal=0.005)),
    Row("given f 0.2 % off", Imperfection(focal=0.002), _LENS),
    Row("given cx 1 px off", Imperfection(centre_px=1.0), _LENS),
    Row("given cx 8 px off", Imperfection(centre_px=8.0), _LENS),
    Row("rational lens", model="rational_polynomial"),
    Row("fisheye lens", model="equidistant"),
    Row("arm 0.4 mm, joints known", Imperfection(table=0.4), Known(arm=True, joints=True)),
    Row("arm 0.4 mm, no joints", Imperfection(table=0.4), Known(arm=True)),
    Row("arm 0.4 mm, arm unknown", Imperfection(table=0.4)),
    Row("smooth bias 0.2 px", Imperfection(bias_px=0.2)),
    Row("bracket flexes 0.1°", Imperfection(flex_rad=float(np.radians(0.1)))),
    Row("arm 0.4 mm, arm unknown, by its flanges", Imperfection(table=0.4), by_told_flanges=True),
)
MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
HEADER = ("what is off", "mount", "coverage %", "covered or refused %", "X rms mm", "claimed mm",
          "median χ²/6", "pass %", "pass, beyond 3 σ %", "closed gates %")  # fmt: skip


def run() -> str:
    count = trials(TRIALS)
    cases = [(place, mount) for place in range(len(ROWS)) for mount in MOUNTS]
    rows = rows_of(measure, cases, count, line)
    text = (
        f"{count} cells per row, 25 views, 0.2 px, 0.3 mm, 0.03° (`imperfect_cells`); the lens from the same "
        "pictures unless given, the arm unknown unless said. Signs and directions of what is off are drawn "
        "anew for each cell. Coverage: of the stated 95 % region, over the cells that were solved; covered "
        "or refused: the region holds the truth or the verdict is no pass. Beyond "
        f"{_BEYOND:g} σ: translation or rotation farther off than so many of its stated sigmas. Where "
        "nothing was solved, the closed gate is what was said instead. By its flanges: against the X that "
        "AX = XB finds in true board poses and the flanges as told. A fixed camera's X is off by what an "
        "unknown arm errs on average where the views are; no residual shows it, and no use of its flanges "
        "there."
    )
    return text + "\n\n" + table(HEADER, rows)


def measure(task: tuple[int, Mount, int]) -> CoverageTrial:
    place, mount, seed = task
    row = ROWS[place]
    rng = np.random.default_rng([41, place, MOUNTS.index(mount), seed])
    try:
        with single_threaded_opencv():
            cell = imperfect_cell(rng, mount, row.wrong, row.known, row.model)
            solution = solve_views(cell.views, SolveOptions(intrinsics_from_same_pictures=not row.known.lens))
    except CalibrationError as problem:
        return CoverageTrial((str(problem.values.get("hypothesis", type(problem).__name__)),))
    gates = judge(solution)
    told = mount_poses(cell.told, mount)
    miss = Miss.of(solution, solve_global(all_pairs(told, cell.C)).X if row.by_told_flanges else cell.X)
    beyond = (
        miss.shift_m > _BEYOND * solution.sigma_translation_m
        or miss.turn_rad > _BEYOND * solution.sigma_rotation_rad
    )
    closed = tuple(
        f"session: {solution.judgement.session.reading.value}" if gate.name == "session" else gate.name
        for gate in gates
        if not gate.passed
    )
    return CoverageTrial(closed, miss, beyond, solution.sigma_translation_m)


def line(case: tuple[int, Mount], found: list[CoverageTrial]) -> list[str]:
    solved = [(trial.miss, trial.claimed_m) for trial in found if trial.miss is not None]
    misses = [miss for miss, _ in solved]
    closed = Counter(name for trial in found for name in trial.closed)

    def percent(count: int, of: Sequence[object] = found) -> str:
        return f"{100 * count / max(len(of), 1):.1f}"

    return [
        ROWS[case[0]].name,
        case[1],
        percent(sum(miss.covered for miss in misses), misses),
        percent(sum((t.miss is not None and t.miss.covered) or bool(t.closed) for t in found)),
        f"{1e3 * rms(np.array([miss.shift_m for miss in misses])):.3f}",
        f"{1e3 * rms(np.array([claimed_m for _, claimed_m in solved])):.3f}",
        f"{np.median([miss.square for miss in misses]) / 6:.2f}",
        percent(sum(not t.closed for t in found)),
        percent(sum(t.beyond and not t.closed for t in found)),
        ", ".join(f"{name} {percent(k)}" for name, k in closed.most_common()),
    ]
