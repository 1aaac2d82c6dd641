"""Cost of the larger model where a smaller one would be right.

The board is exact, the lens comes from the same pictures or is given and right, all noise is independent: the
Cramér-Rao bound is that of a model which knows all this, and the true noise scales. The estimator is the
product's; it is told none of it, but for the tolerance of a board and a lens that were measured.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.scene import LEVELS, CellNoise, SceneCell, make_cell
from benchmarks.trials import rms, rms_spread, share_spread, table, trials
from calibrate.boards.model import board_points
from calibrate.geometry import Array, difference
from calibrate.handeye.information import MeasurementNoise as ViewNoise
from calibrate.handeye.information import covariance_of, view_information
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.solution import Solution, SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.projection import intrinsics_names, intrinsics_vector
from calibrate.results import SHAPE
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel

TRIALS = 300
BOARDS = {"usual tolerance": BoardTolerance(), "measured": BoardTolerance(1e-5, 2e-5)}
ROWS = (
    *(("mid", views, lens) for lens in ("same pictures", "given") for views in (8, 12, 25, 50)),
    *((level, 25, "same pictures") for level in ("low", "high")),
)
HEADER = ("noise", "lens", "views", "board", "rms mm", "rms °", "/ bound, translation", "/ bound, rotation",
          "coverage %")  # fmt: skip
_BOARD = BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025)
_MEASURED_LENS = 1e-4
"""Relative 1σ of the focal length of a lens that was measured; the others alike."""


def run() -> str:
    count = trials(TRIALS)
    rows = []
    for level, views, lens in ROWS:
        for line in _rows(level, views, lens, count):
            rows.append(line)
            print(" | ".join(line), flush=True)
    text = (
        f"{count} cells per row, each a new scene (paper's cell), the same for both boards; ± is one "
        "standard error. Bound: root of the trace of the inverse Fisher information at the truth. Noise "
        "(corner px, robot mm, robot °): low 0.1/0.05/0.005, mid 0.2/0.3/0.03, high 0.5/1/0.1. Usual: "
        "squares and print 0.3 %, flatness 1 mm; measured: 0.001 %, 0.02 mm. Given: the true lens, 1σ "
        "stated as 0.01 %."
    )
    return text + "\n\n" + table(HEADER, rows)


def _rows(level: str, views: int, lens: str, count: int) -> list[list[str]]:
    noise, free = LEVELS[level], lens == "same pictures"
    rng = np.random.default_rng([views, int(free), list(LEVELS).index(level)])
    errors = np.zeros((len(BOARDS), count, 2))
    bounds, inside = np.zeros((count, 2)), np.zeros(len(BOARDS))
    for k in range(count):
        cell = make_cell(rng, views, noise, with_pnp=False)
        covariance = bound(cell, noise, free)
        bounds[k] = np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])
        for place, solution in enumerate(solve(cell, free)):
            delta = difference(solution.matrix, cell.X)
            errors[place, k] = np.linalg.norm(delta[:3]), np.linalg.norm(delta[3:])
            square = float(delta @ np.linalg.solve(solution.covariance, delta))
            inside[place] += square <= solution.confidence_threshold
    floor = np.sqrt(bounds.mean(axis=0))
    return [
        [
            level,
            lens,
            str(views),
            board,
            f"{1e3 * rms(error[:, 0]):.3f}",
            f"{np.degrees(rms(error[:, 1])):.4f}",
            *(
                f"{rms(error[:, i]) / floor[i]:.3f} ± {rms_spread(error[:, i]) / floor[i]:.3f}"
                for i in (0, 1)
            ),
            f"{100 * held / count:.1f} ± {100 * share_spread(float(held) / count, count):.1f}",
        ]
        for board, error, held in zip(BOARDS, errors, inside, strict=True)
    ]


def bound(cell: SceneCell, noise: CellNoise, free: bool) -> Array:
    """(6, 6) inverse Fisher information of X at the truth, the board's shape known, the lens unless free."""
    each = view_information(
        cell.views.mount,
        cell.camera,
        cell.flange,
        cell.X,
        cell.Y,
        board_points(_BOARD),
        ViewNoise(noise.corner_px, noise.robot_m, noise.robot_rad),
    )
    unknown = each.shape[-1] - len(SHAPE) if free else 12
    return covariance_of(each.sum(axis=0)[:unknown, :unknown])[:6, :6]


def solve(cell: SceneCell, free: bool) -> list[Solution]:
    """One solution for each of BOARDS."""
    views, sigma = cell.views, None
    if free:
        unknown = CameraModel(cell.camera.width, cell.camera.height)
        views = replace(views, camera=calibrate_intrinsics(replace(views, camera=unknown)).camera)
    else:
        scale = np.ones(len(intrinsics_names(cell.camera)))
        scale[:4] = intrinsics_vector(cell.camera)[:4]
        sigma = tuple((_MEASURED_LENS * scale).tolist())
    views = solve_pnp(views, _BOARD)
    options = SolveOptions(intrinsics_from_same_pictures=free, lens_sigma=sigma, holdout=False, folds=False)
    return [solve_views(views, replace(options, board=board)) for board in BOARDS.values()]
