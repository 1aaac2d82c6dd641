"""ViewSet in, Solution out: checks of the input, the profile asked for, and the paper's own experiment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import special

from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.geometry import Array, Transform, is_rigid
from calibrate.handeye.axxb.certificate import Certificate, certify
from calibrate.handeye.axxb.objective import QuadraticObjective, build_objective, pair_covariance
from calibrate.handeye.axxb.pairs import consecutive_pairs, mount_poses
from calibrate.handeye.axxb.paper import solve_paper
from calibrate.handeye.metrics import (
    HELD_OUT,
    board_spread,
    mean_pose,
    median_distance_m,
    observe,
    placed_boards,
    point_error_m,
    require_motion,
    score_holdout,
)
from calibrate.handeye.profile_robust import solve_robust_profile
from calibrate.handeye.solution import Remark, Solution, SolveOptions, board_frames, camera_frames
from calibrate.projection import camera_matrix
from calibrate.stopwatch import Stopwatch
from calibrate.views import BoardView, ViewSet, require_no_copies

__all__ = ["Solution", "SolveOptions", "solve_views"]


def solve_views(views: ViewSet, options: SolveOptions | None = None) -> Solution:
    """Calibrate from views that have `camera_from_board` (run PnP first).

    Same views, options and machine give the same bits. Raises TooFewViewsError, DegenerateMotionError or
    BadViewsError; what is merely doubtful comes back in `warnings`.
    """
    options = options or SolveOptions()
    require_solvable(views)
    if options.profile == "paper":
        return solve_paper_profile(views, options)
    return solve_robust_profile(views, options)


MIN_VIEWS = 4
FEWEST_CORNERS = 4
MAX_VIEWS = 20_000
"""Beyond this the last stage would need more than a minute and a gigabyte."""


def require_solvable(views: ViewSet) -> None:
    """Raise TooFewViewsError or BadViewsError, naming view and remedy."""
    if len(views) < MIN_VIEWS:
        raise TooFewViewsError(
            f"{len(views)} usable views (minimum {MIN_VIEWS}).",
            remedy="Record 15 to 25 poses, or check why the board was not found in the others.",
            views=len(views),
            minimum=MIN_VIEWS,
        )
    if len(views) > MAX_VIEWS:
        raise BadViewsError(
            f"{len(views)} views (limit {MAX_VIEWS}).", code="too-many-views", remedy="Split the recording."
        )
    fewest = FEWEST_CORNERS if any(len(view.pixels) for view in views) else 0
    if views.camera.matrix is not None or fewest:
        camera_matrix(views.camera)
        if not np.isfinite(views.camera.distortion).all():
            raise BadViewsError(
                "The distortion is not finite.", code="distortion", remedy="Correct it, or estimate it."
            )
    for view in views:
        _require_view(view, fewest)
    first = views.views[0].base_from_flange
    if all(np.abs(view.base_from_flange - first).max() < 1e-9 for view in views):
        raise BadViewsError(
            "All robot poses are identical.", code="poses-identical", remedy="Check how they were recorded."
        )
    require_no_copies(views)


def _require_view(view: BoardView, fewest_corners: int) -> None:
    def require(right: bool, code: str, wrong: str) -> None:
        if not right:
            raise BadViewsError(
                f"View {view.index + 1} ({view.name}): {wrong}.",
                code=code,
                remedy="Correct or remove this view.",
                view=view.index + 1,
            )

    T, corners = np.array(view.camera_from_board), len(view.pixels)
    require(is_rigid(np.asarray(view.base_from_flange)), "robot-pose", "the robot pose is no rigid transform")
    require(T.shape == (4, 4), "no-board-pose", "no board pose is known")
    require(is_rigid(T), "board-pose", "the board pose is mirrored or no rigid transform")
    require(T[2, 3] > 0, "board-pose", "the board pose lies behind the camera")
    points = len(view.board_points)
    require(corners == points, "corners", f"{corners} pixels for {points} board points")
    require(corners >= fewest_corners, "corners", f"{corners} corners (minimum {fewest_corners})")
    finite = np.isfinite(view.pixels).all() and np.isfinite(view.board_points).all()
    require(bool(finite), "corners", "a corner is not finite")


def solve_paper_profile(views: ViewSet, options: SolveOptions) -> Solution:
    """Run the paper's experiment: consecutive pairs (eq. 21), the last 6 of them to score (eqs. 24-26)."""
    watch = Stopwatch()
    H, C = mount_poses(views.base_from_flange, views.mount), views.camera_from_board
    pairs = consecutive_pairs(H, C)
    held = HELD_OUT if options.holdout and len(pairs) >= HELD_OUT + 3 else 0
    fit = pairs.select(slice(0, len(pairs) - held))
    require_motion(fit)
    result = solve_paper(fit, options.seed)
    watch.lap("evolution")
    X, indices = result.X, [view.index for view in views]
    covariance = pair_covariance(result.objective, fit, X)
    distance = options.working_distance_m or median_distance_m(C)
    parent, _ = camera_frames(views.mount)
    certificate = _of_returned(build_objective(fit, "log", centre=X), X, len(fit))
    spread_m, spread_rad = board_spread(H, C, X)
    fitted = len(fit) + 1
    note = f"pairs {len(fit)} and {len(fit) + 1} share a pose, as in the paper"
    watch.lap("assess")
    return Solution(
        mount=views.mount,
        profile="paper",
        parent_from_child=Transform(*camera_frames(views.mount), X),
        covariance=covariance,
        confidence_threshold=float(6 * special.fdtri(6, max(6 * len(fit) - 6, 1), 0.95)),
        board_place=Transform(*board_frames(views.mount), mean_pose(placed_boards(H, C, X))),
        camera=views.camera,
        rms_px=None,
        used=tuple(indices),
        rejected=(),
        certificate=certificate,
        observability=observe(fit, covariance, distance, parent),
        holdout=score_holdout(X, pairs.select(slice(len(fit), None)), indices, fitted, note)
        if held
        else None,
        kept=views.views,
        predicted_error_m=point_error_m(X, covariance, distance),
        working_distance_m=distance,
        board_spread_m=spread_m,
        board_spread_rad=spread_rad,
        on_box=result.on_box,
        warnings=_paper_warnings(result.on_box, held, certificate),
        stage_ms=watch.stage_ms,
        solve_ms=watch.total_ms,
        seed=options.seed,
    )


def _of_returned(objective: QuadraticObjective, X: Array, pairs: int) -> Certificate:
    """The bound of the relaxation against the value at the X that is returned, translation included.

    `certify` itself judges the rotation, with the best translation for it.
    """
    problem = (
        f"logarithmic objective of eq. 16 (lambda 1) over the {pairs} consecutive pairs that were fitted"
    )
    proof = certify(objective, problem).certificate
    value = objective.value(X)
    gap = max(0.0, value - proof.lower_bound) / max(value, proof.floor)
    return replace(proof, objective=value, relative_gap=gap, certified=gap <= proof.tolerance)


def _paper_warnings(on_box: tuple[str, ...], held: int, proof: Certificate) -> tuple[Remark, ...]:
    slow = proof.objective > 1.05 * max(proof.lower_bound, proof.floor)
    box = f"X lies on the box of eq. 22 ({', '.join(on_box)}) and is wrong. Use the robust profile."
    said = (
        (bool(on_box), "on-box", box),
        (not held, "no-hold-out", f"Too few pairs to hold out {HELD_OUT}: nothing scores this X."),
        (slow, "budget-ended", "The paper's budget ended more than 5 % above the proven bound."),
    )
    return tuple(Remark(code, text) for true, code, text in said if true)
