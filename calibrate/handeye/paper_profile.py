"""The paper's own experiment on the same views: its pairs, its objective, its budget, its scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import special

from calibrate.handeye.axxb.certificate import TOLERANCE, certify
from calibrate.handeye.axxb.objective import QuadraticObjective, build_objective, pair_covariance
from calibrate.handeye.axxb.pairs import consecutive_pairs, mount_poses
from calibrate.handeye.axxb.paper import solve_paper
from calibrate.handeye.metrics import (
    HELD_OUT,
    board_spread,
    mean_pose,
    median_distance_m,
    observe,
    picture_coverage,
    point_error_m,
    require_motion,
    score_holdout,
)
from calibrate.handeye.solution import (
    Evidence,
    FittedCell,
    Judgement,
    Solution,
    SolveOptions,
    board_frames,
    camera_frames,
)
from calibrate.results import Certificate, QualityFigures, Remark, ViewQuality, Views
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, Transform


def solve_paper_profile(views: ViewSet, options: SolveOptions) -> Solution:
    """Run the paper's experiment: consecutive pairs (eq. 21), the last 6 of them to score (eqs. 24-26)."""
    H = mount_poses(views.base_from_flange, views.mount)
    C = views.camera_from_board
    pairs = consecutive_pairs(H, C)
    held = HELD_OUT if options.holdout and len(pairs) >= HELD_OUT + 3 else 0
    fitted = pairs.select(slice(0, len(pairs) - held))
    require_motion(fitted)
    result = solve_paper(fitted, options.seed)
    X = result.X
    indices = [view.index for view in views]
    covariance = pair_covariance(result.objective, fitted, X)
    distance_m = options.working_distance_m or median_distance_m(C)
    certificate = _of_returned(build_objective(fitted, "log", centre=X), X, len(fitted))
    spread_m, spread_rad = board_spread(H, C, X)
    note = f"pairs {len(fitted)} and {len(fitted) + 1} share a pose, as in the paper"
    scored = pairs.select(slice(len(fitted), None))
    parent, child = camera_frames(views.mount)
    cell = FittedCell(
        mount=views.mount,
        parent_from_child=Transform(parent, child, X),
        covariance=covariance,
        confidence_threshold=float(6 * special.fdtri(6, max(6 * len(fitted) - 6, 1), 0.95)),
        board_place=Transform(*board_frames(views.mount), mean_pose(H @ X @ C)),
        camera=views.camera,
        lens_estimated=options.intrinsics_from_same_pictures,
    )
    figures = QualityFigures(
        certificate=certificate,
        holdout=score_holdout(X, scored, indices, len(fitted) + 1, note) if held else None,
        board_spread_mm=1e3 * spread_m,
        board_spread_deg=float(np.degrees(spread_rad)),
        predicted_error_mm=1e3 * point_error_m(X, covariance, distance_m),
        working_distance_m=distance_m,
    )
    judgement = Judgement(
        figures=figures,
        observability=observe(fitted, covariance, distance_m, parent),
        coverage=picture_coverage(views.views, views.camera),
        on_box=result.on_box,
        warnings=_paper_warnings(result.on_box, held, certificate),
    )
    evidence = Evidence(
        views=Views(used=indices),
        kept=views.views,
        residuals=tuple(ViewQuality(index) for index in indices),
    )
    return Solution(cell, judgement, evidence, profile="paper", seed=options.seed)


def _of_returned(objective: QuadraticObjective, X: Array, pairs: int) -> Certificate:
    """Compare the relaxation's lower bound with the value at the returned X, translation included.

    `certify` itself compares it with the best translation for the rotation.
    """
    problem = (
        f"logarithmic objective of eq. 16 (lambda 1) over the {pairs} consecutive pairs that were fitted"
    )
    proof = certify(objective, problem).certificate
    value = objective.value(X)
    gap = max(0.0, value - proof.lower_bound) / max(value, proof.floor)
    return replace(proof, objective=value, relative_gap=gap, certified=gap <= TOLERANCE)


def _paper_warnings(on_box: tuple[str, ...], held: int, proof: Certificate) -> tuple[Remark, ...]:
    slow = proof.objective > 1.05 * max(proof.lower_bound, proof.floor)
    box = f"X lies on the box of eq. 22 ({', '.join(on_box)}) and is wrong. Use the robust profile."
    said = (
        (bool(on_box), "on-box", box),
        (not held, "no-hold-out", f"Too few pairs to hold out {HELD_OUT}: nothing scores this X."),
        (slow, "budget-ended", "The paper's budget ended more than 5 % above the proven bound."),
    )
    return tuple(Remark(code, text) for true, code, text in said if true)
