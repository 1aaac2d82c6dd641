"""Arms that nobody described: the chain learned from recorded joints, against the same views without them."""

from __future__ import annotations

import numpy as np

from benchmarks.trials import Miss, rms, rows_of, table, trials
from calibrate.handeye.solution import SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.handeye.workspace import Workspace, sample_range
from recordings.geometry import Array, difference, rotation_log
from recordings.schema.messages import Mount
from tests.calibrate.chains import ArmCell, arm_cell

TRIALS = 200
ARMS = ("ur", "spherical wrist", "seven joints")
MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
SIZES_MM = (0.0, 0.1, 0.3)
HEADER = ("arm", "mount", "links mm", "coverage %", "median χ²/6", "X rms mm", "claimed mm",
          "without joints: coverage %", "X rms mm", "installed X over the range: rms mm", "claimed mm",
          "within 2 claimed %")  # fmt: skip
_AHEAD_M = 0.5


def run() -> str:
    count = trials(TRIALS)
    cases = [(arm, mount, size) for arm in ARMS for mount in MOUNTS for size in SIZES_MM]
    rows = rows_of(measure, cases, count, line)
    text = (
        f"{count} cells a row (`tests/calibrate/chains.py`): 25 views, each link but the last off by so many "
        "mm and mrad (1σ) in each direction, corners 0.15 px, robot noise 0.02 mm and 0.02 mrad. Known: "
        "recorded joints and flanges, no table, no model's name. Coverage: of the stated 95 % region of X, "
        "beside corrected flanges. Installed: the X for the arm as it is, at 400 postures within the "
        "recorded range, points 0.5 m ahead (eye-to-hand: of the board's origin), one rigid motion allowed."
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
    installed = learned.fit.arm.uncorrected
    lengths_m = [miss.shift_m, learned.sigma_translation_m, plain_miss.shift_m]
    lengths_m += [over_range(cell, installed.X), installed.error_m]
    error, claimed, plain_error, over, said = (1e3 * length for length in lengths_m)
    return miss.covered, miss.square, error, claimed, plain_miss.covered, plain_error, over, said


def over_range(cell: ArmCell, X: Array) -> float:
    """Rms error, metres, of points placed with X by the controller's flanges, over the recorded range."""
    q = sample_range(np.array([view.joints_rad for view in cell.views]), seed=1)
    told, true = cell.arm.forward(q), cell.arm.forward(q, cell.link_errors)
    R = true[:, :3, :3] @ np.swapaxes(told[:, :3, :3], 1, 2)
    motion = np.concatenate([true[:, :3, 3] - told[:, :3, 3], rotation_log(R)], axis=1)[..., None]
    Y = np.eye(4) if cell.views.mount == "eye-in-hand" else cell.Y
    room = Workspace.of(cell.views.mount, told, motion, cell.X, Y, _AHEAD_M)
    return room.error_m(difference(X, cell.X), np.ones(1))
