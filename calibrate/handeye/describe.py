"""What a fit says: the three parts of a `Solution` of the robust profile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate.errors import BadViewsError
from calibrate.handeye.arm import FLEX
from calibrate.handeye.arm_result import arm_results
from calibrate.handeye.axxb.objective import pair_covariance
from calibrate.handeye.axxb.pairs import all_pairs, mount_poses
from calibrate.handeye.cell_fit import STAGES, CellFit
from calibrate.handeye.cell_state import Layout
from calibrate.handeye.corner_fit import fit_corners
from calibrate.handeye.diagnosis import (
    cross_validate,
    error_shares,
    explain_views,
    held_out_elsewhere,
    judge_board,
    judge_lens,
)
from calibrate.handeye.estimate import FULL, NEARLY_SETTLED, estimate
from calibrate.handeye.metrics import (
    FEWEST_FITTED,
    HELD_OUT,
    board_spread,
    distance_in_sigmas,
    median_distance_m,
    observe,
    picture_coverage,
    score_holdout,
)
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.posterior import posterior_of
from calibrate.handeye.reprojection import corner_distance, corner_residuals
from calibrate.handeye.solution import (
    ArmErrors,
    Evidence,
    FittedCell,
    Judgement,
    Solution,
    SolveOptions,
    board_frames,
    camera_frames,
)
from calibrate.handeye.stated_point import state_point
from calibrate.results import (
    Arm,
    ArmErrorValue,
    BoardShape,
    Certificate,
    HoldoutScore,
    QualityFigures,
    ViewQuality,
    Views,
    ViewWeight,
)
from recordings.geometry import Array, Transform, skew


def describe(fit: CellFit, options: SolveOptions) -> Solution:
    """Say all that a fit tells, but how the recording as a whole reads best and what people are warned of."""
    distance_m = options.working_distance_m or median_distance_m(fit.estimate.board_poses[fit.estimate.used])
    stated = _stated_error(fit, options)
    cell = _fitted_cell(fit, options, stated, distance_m)
    evidence = _evidence(fit)
    STAGES.info("%d of %d: %s", 4, 4, "proof on views left out")
    judgement = _judgement(fit, options, cell, evidence, stated, distance_m)
    return Solution(cell, judgement, evidence, profile="robust", seed=options.seed)


def _fitted_cell(fit: CellFit, options: SolveOptions, stated: Array, distance_m: float) -> FittedCell:
    """`stated`: covariance (6, 6) of X by the robot's stated error."""
    found = fit.estimate
    state = found.state
    at = Layout.of(state)
    mount = fit.views.mount
    seen = fit.observed.has_pixels
    return FittedCell(
        mount=mount,
        parent_from_child=Transform(*camera_frames(mount), state.X),
        covariance=found.covariance[:6, :6] + _of_arm(fit, stated),
        confidence_threshold=found.threshold,
        board_place=Transform(*board_frames(mount), state.Y),
        camera=state.camera,
        lens_covariance=found.covariance[at.lens, at.lens] if seen else None,
        lens_estimated=options.intrinsics_from_same_pictures,
        board=_board(fit, found.covariance[at.shape, at.shape]) if seen else None,
        arm=_arm(fit, found.covariance[at.arm_errors, at.arm_errors], options, distance_m),
        noise=MeasurementNoise(found.scales.tau_px, *(float(s) for s in found.scales.robot)),
        posterior=posterior_of(fit, stated),
    )


def _judgement(
    fit: CellFit,
    options: SolveOptions,
    cell: FittedCell,
    evidence: Evidence,
    stated: Array,
    distance_m: float,
) -> Judgement:
    seen = fit.observed.has_pixels
    figures = _figures(fit, options, cell, stated, distance_m)
    return Judgement(
        figures=figures,
        observability=observe(fit.pairs, cell.covariance, distance_m, cell.parent_from_child.parent),
        coverage=picture_coverage(evidence.kept, cell.camera),
        lens_finding=judge_lens(fit, distance_m) if seen and not cell.lens_estimated else None,
        board_finding=judge_board(fit, distance_m) if seen else None,
    )


def _figures(
    fit: CellFit, options: SolveOptions, cell: FittedCell, stated: Array, distance_m: float
) -> QualityFigures:
    used = fit.estimate.used
    flanges = mount_poses(fit.views.base_from_flange, fit.views.mount)
    spread_m, spread_rad = board_spread(flanges[used], fit.estimate.board_poses[used], cell.X)
    corrected = None if cell.arm is None else cell.arm.result
    corrected_mm = corrected.with_table_mm if corrected is not None and corrected.offered else None
    point = state_point(fit, cell.installed[0], _of_told(fit, stated), distance_m, corrected_mm)
    return QualityFigures(
        certificate=_certificate(fit, cell.X),
        holdout=_holdout(fit) if options.holdout else None,
        rms_px=_rms_px(fit),
        board_spread_mm=1e3 * spread_m,
        board_spread_deg=float(np.degrees(spread_rad)),
        predicted_error_mm=point.error_mm,
        working_distance_m=distance_m,
        error_shares=error_shares(fit, _of_arm(fit, stated)),
        cross_validation=cross_validate(fit, options.seed) if options.folds else None,
        point=point,
    )


def _evidence(fit: CellFit) -> Evidence:
    found = fit.estimate
    views = fit.views.views
    numbers = [view.index for view in views]
    used = [int(place) for place in np.flatnonzero(found.used)]
    ordinary = found.chances[:, 0]
    suspects = {numbers[place]: float(1 - ordinary[place]) for place in used if ordinary[place] <= FULL}
    return Evidence(
        views=Views(
            used=[numbers[place] for place in used],
            rejected=list(explain_views(fit, np.flatnonzero(~found.used))),
            turned=[numbers[place] for place in fit.turned],
            weights=[ViewWeight(n, float(w)) for n, w in zip(numbers, found.weight, strict=True)],
        ),
        kept=tuple(replace(views[place], camera_from_board=found.board_poses[place]) for place in used),
        suspects=suspects,
        residuals=_residuals(fit, used),
    )


def _residuals(fit: CellFit, used: list[int]) -> tuple[ViewQuality, ...]:
    robot = fit.estimate.robot
    rms_px = _view_rms_px(fit)
    return tuple(
        ViewQuality(
            index=fit.views.views[place].index,
            rms_px=None if rms_px is None else float(rms_px[place]),
            robot_mm=1e3 * float(np.linalg.norm(robot[place, :3])),
            robot_deg=float(np.degrees(np.linalg.norm(robot[place, 3:]))),
        )
        for place in used
    )


def _certificate(fit: CellFit, X: Array) -> Certificate:
    """Return the proof of the optimum over pairs, with its distance from the X of all evidence."""
    proven = fit.certified
    own_covariance = pair_covariance(proven.objective, fit.pairs, proven.X)
    return replace(proven.certificate, distance_sigma=distance_in_sigmas(proven.X, X, own_covariance))


def _stated_error(fit: CellFit, options: SolveOptions) -> Array:
    """Compute the covariance (6, 6) of X by the stated error of the robot, which no number of views lowers.

    Zero where the arm is modelled. The error turns the flange about itself: eye-to-hand about the mean place
    of the flange.
    """
    if fit.arm is not None:
        return np.zeros((6, 6))
    metres = options.robot_accuracy_m or 0.0
    radians = metres if options.robot_accuracy_rad is None else options.robot_accuracy_rad
    pivot = np.zeros(3)
    if fit.views.mount == "eye-to-hand":
        pivot = fit.views.base_from_flange[fit.estimate.used, :3, 3].mean(axis=0)
    J = np.eye(6)
    J[:3, 3:] = -skew(fit.estimate.state.X[:3, 3] - pivot)
    return np.asarray(J * np.repeat([metres, radians], 3) ** 2 @ J.T)


def _of_arm(fit: CellFit, stated: Array) -> Array:
    """Compute the covariance (6, 6) of X by errors of the arm that its links do not explain."""
    return _of_told(fit, stated) + fit.unknown_arm


def _of_told(fit: CellFit, stated: Array) -> Array:
    """Return `stated`; zero where a typical arm of this accuracy was fitted in its place."""
    return stated if fit.assumed is None else np.zeros((6, 6))


def _rms_px(fit: CellFit) -> float | None:
    """Compute the rms reprojection error, px, over all corners of the used views; None without corners."""
    square = _square_misses(fit)
    if square is None:
        return None
    used = fit.estimate.used
    return float(np.sqrt(square[used].sum() / fit.observed.present[used].sum()))


def _view_rms_px(fit: CellFit) -> Array | None:
    """Compute the rms reprojection error (n,), px, of each view; None without corners."""
    square = _square_misses(fit)
    return None if square is None else np.sqrt(square.sum(axis=1) / fit.observed.present.sum(axis=1))


def _square_misses(fit: CellFit) -> Array | None:
    """Square the distances (n, k), px, of corners from the model; 0 for padding, None without corners.

    Each view has the board pose that fits its own corners.
    """
    if not fit.observed.has_pixels:
        return None
    found = fit.estimate
    residual = corner_residuals(fit.observed, found.state.camera, found.board_poses, found.state.shape)
    distance = np.nan_to_num(corner_distance(residual), nan=1e6, posinf=1e6)
    return np.asarray(distance**2 * fit.observed.present)


def _board(fit: CellFit, covariance: Array) -> BoardShape:
    scale, anisotropy, *bend = fit.estimate.state.shape.tolist()
    return BoardShape(scale, anisotropy, tuple(bend), tuple(np.sqrt(np.diag(covariance)).tolist()))


def _arm(fit: CellFit, covariance: Array, options: SolveOptions, distance_m: float) -> ArmErrors | None:
    if fit.log_bayes is None:
        return None
    names = FLEX if fit.arm is None else (*fit.arm.chain.link_errors, *FLEX)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    found = zip(names, fit.estimate.state.arm_errors.tolist(), sigma.tolist(), strict=True)
    size = fit.estimate.scales.arm_error_sigma
    stated = Arm(
        applied=fit.log_bayes > 3.0,  # strong evidence, by Kass and Raftery (1995)
        log_bayes=fit.log_bayes,
        size_mm=0.0 if fit.arm is None else float(size[0]),
        table=[ArmErrorValue(*each) for each in found],
        size_mrad=float(size[3]),
    )
    if fit.arm is None:
        return ArmErrors(stated)
    missed = held_out_elsewhere(fit, fit.arm.joints_rad) if stated.applied and options.folds else None
    return ArmErrors(stated, *arm_results(fit, fit.arm, stated.applied, distance_m, missed))


def _holdout(fit: CellFit) -> HoldoutScore | None:
    """Fit on all but the last 6 used views, lens included; score all pairs inside those 6.

    The fit starts at the estimate of all views. That saves steps and does not change the optimum.
    """
    used = np.flatnonzero(fit.estimate.used)
    first = used[:-HELD_OUT]
    last = used[-HELD_OUT:]
    if len(first) < FEWEST_FITTED:
        return None
    whole = fit.estimate
    try:
        start = replace(whole.state, C=whole.state.C[first])
        partial = estimate(fit.observed.part(first), start, fit.priors, whole.scales, settled=NEARLY_SETTLED)
    except BadViewsError:
        return None
    H = mount_poses(fit.views.base_from_flange, fit.views.mount)[last]
    seen, C = fit.observed.part(last), whole.board_poses[last]
    C = fit_corners(seen, partial.state.camera, C, shape=partial.state.shape, robust=True).C
    pairs = all_pairs(H, C)
    indices = [fit.views.views[i].index for i in last]
    note = f"fit on {len(first)} views, all {len(pairs)} pairs inside the other {HELD_OUT} scored"
    return score_holdout(partial.state.X, pairs, indices, len(first), note)
