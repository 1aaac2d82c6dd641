"""`--profile paper`: the paper's own experiment."""

from __future__ import annotations

from dataclasses import replace

from scipy import special

from calibrate.geometry import Array, Transform
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
from calibrate.handeye.solution import Remark, Solution, SolveOptions, board_frames, camera_frames
from calibrate.stopwatch import Stopwatch
from calibrate.views import ViewSet


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
