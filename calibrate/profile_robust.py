"""`--profile robust`: certain first estimate over all pairs, then what makes it precise and honest."""

from __future__ import annotations

import time

from scipy import stats

from calibrate.assess import (
    board_places,
    board_spread,
    mean_pose,
    median_distance_m,
    observe,
    point_error_m,
    require_motion,
    score_holdout,
)
from calibrate.frames import board_frames, camera_frames
from calibrate.geometry import Transform
from calibrate.pairs import all_pairs, mount_poses
from calibrate.robust import solve_global
from calibrate.solution import HoldoutScore, Solution, SolveOptions
from calibrate.views import ViewSet

HELD_OUT = 6
"""Views kept for the score: fit on the first 19 of 25."""


def solve_robust_profile(views: ViewSet, options: SolveOptions) -> Solution:
    start = time.perf_counter()
    H, C = mount_poses(views.base_from_flange, views.mount), views.camera_from_board
    pairs = all_pairs(H, C)
    require_motion(pairs)
    result = solve_global(
        pairs, options.seed, f"chordal objective over {len(pairs)} pairs of {len(views)} views"
    )
    X = result.X
    covariance = result.objective.covariance(X)
    distance = options.working_distance_m or median_distance_m(C)
    spread_m, spread_rad = board_spread(H, C, X)
    holdout = _holdout(views, options) if options.holdout else None
    end = time.perf_counter()
    return Solution(
        mount=views.mount,
        profile="robust",
        parent_from_child=Transform(*camera_frames(views.mount), X),
        covariance=covariance,
        confidence_threshold=float(6 * stats.f.ppf(0.95, 6, max(3 * len(views) - 6, 1))),
        board_place=Transform(*board_frames(views.mount), mean_pose(board_places(H, C, X))),
        camera=views.camera,
        rms_px=None,
        used=tuple(view.index for view in views),
        rejected=(),
        certificate=result.certificate,
        observability=observe(pairs, covariance, distance, camera_frames(views.mount)[0]),
        holdout=holdout,
        predicted_error_m=point_error_m(X, covariance, distance),
        working_distance_m=distance,
        board_spread_m=spread_m,
        board_spread_rad=spread_rad,
        solve_ms=1e3 * (end - start),
        seed=options.seed,
    )


def _holdout(views: ViewSet, options: SolveOptions) -> HoldoutScore | None:
    fitted = len(views) - HELD_OUT
    if fitted < 4:
        return None
    H, C = mount_poses(views.base_from_flange, views.mount), views.camera_from_board
    X = solve_global(all_pairs(H[:fitted], C[:fitted]), options.seed).X
    scored = all_pairs(H[fitted:], C[fitted:])
    return score_holdout(X, scored, [view.index for view in views.views[fitted:]], fitted)
