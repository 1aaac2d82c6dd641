"""Arms that nobody described: the chain learned from recorded joints, against the same views without them."""

from __future__ import annotations

import numpy as np

from benchmarks.trials import Miss, rms, rows_of, table, trials
from calibrate.handeye.solution import SolveOptions
from calibrate.handeye.solve import solve_views
from recordings.geometry import Array, inverse
from recordings.schema.messages import Mount
from tests.calibrate.chains import ArmCell, arm_cell

TRIALS = 200
ARMS = ("ur", "spherical wrist", "seven joints")
MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
SIZES_MM = (0.0, 0.1, 0.3)
HEADER = ("arm", "mount", "links mm", "coverage %", "median χ²/6", "X rms mm", "claimed mm",
          "without joints: coverage %", "X rms mm", "placed point rms mm", "stated mm",
          "within 2 stated %")  # fmt: skip


def run() -> str:
    count = trials(TRIALS)
    cases = [(arm, mount, size) for arm in ARMS for mount in MOUNTS for size in SIZES_MM]
    rows = rows_of(measure, cases, count, line)
    text = (
        f"{count} cells a row (`tests/calibrate/chains.py`): 25 views, each link but the last off by so many "
        "mm and mrad (1σ) in each direction, corners 0.15 px, robot noise 0.02 mm and 0.02 mrad. Known: "
        "recorded joints and flanges, no table, no model's name. Coverage: of the stated 95 % region of X, "
        "beside corrected flanges. Placed point: with the X that is installed, by the controller's flanges, "
        "at the recorded postures."
    )
    return text + "\n\n" + table(HEADER, rows)


def line(case: tuple[str, Mount, float], cells: list[tuple[float, ...]]) -> list[str]:
    arm, mount, size = case
    inside, square, error, claimed, plain_inside, plain_error, installed, said = np.array(cells).T
    return [
        arm, mount, f"{size:g}", f"{100 * inside.mean():.1f}", f"{np.median(square) / 6:.2f}",
        f"{rms(error):.3f}", f"{rms(claimed):.3f}", f"{100 * plain_inside.mean():.1f}",
        f"{rms(plain_error):.3f}", f"{rms(installed):.3f}", f"{rms(said):.3f}",
        f"{100 * (installed <= 2 * said).mean():.1f}",
    ]  # fmt: skip


def measure(task: tuple[str, Mount, float, int]) -> tuple[float, ...]:
    cell = arm_cell(*task)
    learned, plain = (
        solve_views(views, SolveOptions(holdout=False, folds=False))
        for views in (cell.views, arm_cell(*task, joints=False).views)
    )
    miss, plain_miss = (Miss.of(solution, cell.X) for solution in (learned, plain))
    assert learned.fit.arm is not None and learned.fit.arm.uncorrected is not None
    point = learned.judgement.figures.point
    assert point is not None
    placed_mm = placed(cell, learned.fit.arm.uncorrected.X, point.at_m)
    lengths_m = [miss.shift_m, learned.sigma_translation_m, plain_miss.shift_m]
    error_mm, claimed_mm, plain_mm = (1e3 * length for length in lengths_m)
    return (
        miss.covered,
        miss.square,
        error_mm,
        claimed_mm,
        plain_miss.covered,
        plain_mm,
        placed_mm,
        point.error_mm,
    )


def placed(cell: ArmCell, X: Array, distance_m: float) -> float:
    """Rms error, mm, of points placed with X by the controller's flanges, at the recorded postures.

    By whole matrices: e = F*(b) F(b)⁻¹ F(a) X̂ p - F*(a) X p, and of a fixed camera F*(b) F(b)⁻¹ X̂ p - X p.
    """
    q = np.array([view.joints_rad for view in cell.views])
    told = cell.arm.forward(q)
    true = cell.arm.forward(q, cell.link_errors)
    point = np.array([0.0, 0.0, distance_m, 1.0])
    by_tool = true @ inverse(told)
    if cell.views.mount == "eye-to-hand":
        missed = by_tool @ (X @ point) - cell.X @ point
    else:
        taken = told @ X @ point
        seen = true @ cell.X @ point
        every = np.einsum("bij,aj->abi", by_tool, taken) - seen[:, None]
        missed = every[~np.eye(len(q), dtype=bool)]
    return 1e3 * rms(np.linalg.norm(missed[:, :3], axis=1))
