"""The solver: views in, a `Solution` with uncertainty, checks and warnings out.

Where to find what, in the order of a solve; docs/contributor/solver.md has the equations:

    solve.py        `solve_views`: the fit, then everything that is said of it
      cell_fit.py   `fit_cell`: from views to the estimate of a cell, by
        axxb/         the X of all pairs, proven; the paper's and other methods for A X = X B
        pose_fit.py   `agreed_start` where most views agree; `fit_poses`, a quick fit without corners
        estimate.py   `estimate`: Gauss-Newton over all unknowns (`cell_state.py`), each step by
          linear.py     `Linear`: the likelihood at one state, board poses eliminated: step and noise
                        (`reprojection.py`, `corner_modes.py`, `mixture.py`, `noise_scales.py`, `priors.py`)
        arm_fit.py    the same with errors of arm and bracket (`arm.py`), averaged over their sizes
      readings.py   where the views disagree: the recording as it might be meant, by `fit_poses`
      diagnosis.py, metrics.py, uncertainty.py, arm_result.py, workspace.py    how good it is, and why
      posterior.py  what later checks begin with
    corner_fit.py   lens and board poses by the corners alone, before any solve
    peers.py        published methods beside it; information.py    what poses would tell
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import special

from calibrate.errors import BadViewsError, PosesDisagreeError
from calibrate.handeye.arm import FLEX
from calibrate.handeye.arm_result import arm_results
from calibrate.handeye.axxb.certificate import TOLERANCE, certify
from calibrate.handeye.axxb.objective import QuadraticObjective, build_objective, pair_covariance
from calibrate.handeye.axxb.pairs import all_pairs, consecutive_pairs, mount_poses
from calibrate.handeye.axxb.paper import solve_paper
from calibrate.handeye.blas_threads import one_blas_thread
from calibrate.handeye.board_motion import board_extent_m, boards_own_motion
from calibrate.handeye.cell_fit import STAGES, CellFit, fit_cell
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
from calibrate.handeye.estimate import FULL, estimate
from calibrate.handeye.metrics import (
    FEWEST_FITTED,
    HELD_OUT,
    board_spread,
    distance_in_sigmas,
    mean_pose,
    median_distance_m,
    observe,
    picture_coverage,
    point_error_m,
    require_motion,
    require_solvable,
    score_holdout,
)
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.pose_fit import pose_views
from calibrate.handeye.posterior import posterior_of
from calibrate.handeye.priors import LensPrior, Priors
from calibrate.handeye.readings import CHANGES, explain_changes, explain_recording, explain_text
from calibrate.handeye.reprojection import corner_distance, corner_residuals
from calibrate.handeye.solution import (
    ArmErrors,
    Explanation,
    Reading,
    Solution,
    SolveOptions,
    board_frames,
    camera_frames,
)
from calibrate.results import Arm, ArmErrorValue, BoardShape, Certificate, HoldoutScore, Remark
from calibrate.views.projection import intrinsics_names
from calibrate.views.view_set import BoardView as BoardView
from calibrate.views.view_set import ViewSet as ViewSet
from calibrate.views.view_set import array_of
from recordings.geometry import Array, Transform, skew

__all__ = ["Solution", "SolveOptions", "solve_views"]

_ENOUGH = 0.9
"""Share of views with full weight above which only a change between two views is looked for."""
_NOISY_M, _NOISY_RAD = 0.002, float(np.radians(0.3))
"""Robot noise, 1σ, that is larger than a sound arm's."""
_FREE_FOCAL = 0.02
"""Relative 1σ, for other readings, of a focal length that was estimated from the same images."""


@one_blas_thread()
def solve_views(views: ViewSet, options: SolveOptions | None = None) -> Solution:
    """Calibrate from views that have `camera_from_board` (run PnP first).

    Same views, options and machine give the same bits. Raises TooFewViewsError, DegenerateMotionError or
    BadViewsError; what is merely doubtful comes back in `warnings`.
    """
    options = options or SolveOptions()
    require_solvable(views)
    near = boards_own_motion(views.base_from_flange, views.camera_from_board, board_extent_m(views))
    if near is not None:
        raise BadViewsError("boards-own-poses", away_m=near.away_m, away_rad=near.away_rad)
    if options.profile == "paper":
        return solve_paper_profile(views, options)
    return solve_robust_profile(views, options)


def solve_robust_profile(views: ViewSet, options: SolveOptions) -> Solution:
    """Run the robust profile on all views. PosesDisagreeError names the reading that explains them."""
    priors = _priors(views, options)
    focal_sigma = float(min(priors.lens.sigma[0] / priors.lens.mean[0], _FREE_FOCAL))
    poses = pose_views(views, focal_sigma, priors.board.square)
    try:
        fit = fit_cell(views, priors, options.seed)
    except PosesDisagreeError as problem:
        session = explain_recording(
            poses, options.seed, unmirrored=options.unmirrored, pictured=_with_told_lens(views, options)
        )
        raise PosesDisagreeError(
            hypothesis=session.reading.value, **problem.values | {"advice": explain_text(session, views)}
        ) from None
    solution = _describe(fit, options)
    by_links = None if fit.arm is None else fit.arm.chain.by_links(fit.arm.joints_rad)
    disagree = float((fit.estimate.chances[:, 0] > FULL).mean()) < _ENOUGH
    if disagree or _doubtful(solution):
        pictured = _with_told_lens(fit.views, options)
        session = explain_recording(poses, options.seed, by_links, options.unmirrored, pictured)
    else:
        session = explain_changes(poses, options.seed, by_links)
    if session.reading in CHANGES:
        at, first, last = (fit.views.views[place].index for place in (session.at, *session.between))
        session = replace(session, numbers=(at, first, last))
    return replace(solution, session=session, warnings=_remarks(fit, solution, session))


def _with_told_lens(views: ViewSet, options: SolveOptions) -> ViewSet | None:
    """Return the views where their lens was told; None where it was found from the same images."""
    return None if options.intrinsics_from_same_pictures else views


def _priors(views: ViewSet, options: SolveOptions) -> Priors:
    if options.intrinsics_from_same_pictures:
        return Priors(LensPrior.unknown(views.camera), options.board)
    sigma, names = options.lens_sigma, intrinsics_names(views.camera)
    given = None if sigma is None else array_of(sigma, (len(names),), "lens_sigma")
    return Priors(LensPrior.given(views.camera, given), options.board)


def _doubtful(solution: Solution) -> bool:
    """Tell whether another reading of the recording might explain what this solution leaves."""
    folds, noise = solution.cross_validation, solution.noise
    findings = (solution.lens_finding, solution.board_finding)
    return bool(
        (folds is not None and folds.rms_mm > folds.limit * folds.claimed_mm)
        or any(finding is not None and finding.unexplained_m > 0 for finding in findings)
        or (noise is not None and (noise.robot_m > _NOISY_M or noise.robot_rad > _NOISY_RAD))
    )


def _describe(fit: CellFit, options: SolveOptions) -> Solution:
    views, found, state = fit.views, fit.estimate, fit.estimate.state
    at, indices = Layout.of(state), [view.index for view in views]
    used = np.flatnonzero(found.used)
    H, C = mount_poses(views.base_from_flange, views.mount), found.board_poses
    parent, child = camera_frames(views.mount)
    distance = options.working_distance_m or median_distance_m(C[used])
    stated = _common_error(views.select([*used]), state.X, options) if fit.arm is None else np.zeros((6, 6))
    by_unknown_arm = stated + fit.unknown_arm
    covariance = found.covariance[:6, :6] + by_unknown_arm
    arm = _arm(fit, found.covariance[at.arm_errors, at.arm_errors], options, distance)
    installed = None if arm is None else arm.installed
    pairs, certified = fit.pairs, fit.certified
    apart = distance_in_sigmas(certified.X, state.X, pair_covariance(certified.objective, pairs, certified.X))
    spread_m, spread_rad = board_spread(H[used], C[used], state.X)
    seen = fit.observed.has_pixels
    lens_finding = judge_lens(fit, distance) if seen and not options.intrinsics_from_same_pictures else None
    board_finding = judge_board(fit, distance) if seen else None
    STAGES.info("4 of 4: proof on views left out")
    folds = cross_validate(fit, options.seed) if options.folds else None
    holdout = _holdout(fit) if options.holdout else None
    rms_px, view_rms_px = _corner_rms(fit)
    kept = tuple(replace(views.views[i], camera_from_board=C[i]) for i in used)
    return Solution(
        mount=views.mount,
        profile="robust",
        parent_from_child=Transform(parent, child, state.X),
        covariance=covariance,
        confidence_threshold=found.threshold,
        board_place=Transform(*board_frames(views.mount), state.Y),
        camera=state.camera,
        rms_px=rms_px,
        used=tuple(indices[i] for i in used),
        rejected=explain_views(fit, np.flatnonzero(~found.used)),
        certificate=replace(certified.certificate, distance_sigma=apart),
        observability=observe(pairs, covariance, distance, parent),
        holdout=holdout,
        kept=kept,
        turned=tuple(indices[i] for i in fit.turned),
        weights={index: float(w) for index, w in zip(indices, found.weight, strict=True)},
        suspects={indices[i]: float(1 - found.chances[i, 0]) for i in used if found.chances[i, 0] <= FULL},
        cross_validation=folds,
        coverage=picture_coverage(kept, state.camera),
        lens_estimated=options.intrinsics_from_same_pictures,
        lens_finding=lens_finding,
        lens_covariance=found.covariance[at.lens, at.lens] if seen else None,
        board=_board(fit, found.covariance[at.shape, at.shape]) if seen else None,
        board_finding=board_finding,
        noise=MeasurementNoise(found.scales.tau_px, *(float(s) for s in found.scales.robot)),
        error_shares=error_shares(fit, by_unknown_arm),
        arm=arm,
        without_arm=fit.arm is None and not stated.any(),
        predicted_error_m=point_error_m(state.X, covariance, distance)
        if installed is None
        else installed.error_m,
        working_distance_m=distance,
        board_spread_m=spread_m,
        board_spread_rad=spread_rad,
        residual_px={indices[i]: float(view_rms_px[i]) for i in used} if seen else {},
        residual_robot={
            indices[i]: (float(np.linalg.norm(found.robot[i, :3])), float(np.linalg.norm(found.robot[i, 3:])))
            for i in used
        },
        posterior=posterior_of(fit, stated),
        seed=options.seed,
    )


def _common_error(views: ViewSet, X: Array, options: SolveOptions) -> Array:
    """Compute the covariance (6, 6) of X by the stated error of the robot, which no number of views lowers.

    It turns the flange about itself: eye-to-hand about the mean place of the flange.
    """
    metres = options.robot_accuracy_m or 0.0
    radians = metres if options.robot_accuracy_rad is None else options.robot_accuracy_rad
    pivot = np.zeros(3) if views.mount == "eye-in-hand" else views.base_from_flange[:, :3, 3].mean(axis=0)
    J = np.eye(6)
    J[:3, 3:] = -skew(X[:3, 3] - pivot)
    return np.asarray(J * np.repeat([metres, radians], 3) ** 2 @ J.T)


def _corner_rms(fit: CellFit) -> tuple[float | None, Array]:
    """Compute the rms reprojection error (px) over all used views, and of each view (n,).

    Each view has the board pose that fits its own corners.
    """
    found = fit.estimate
    if not fit.observed.has_pixels:
        return None, np.zeros(len(fit.views))
    residual = corner_residuals(fit.observed, found.state.camera, found.board_poses, found.state.shape)
    square = np.nan_to_num(corner_distance(residual), nan=1e6, posinf=1e6) ** 2 * fit.observed.present
    count = fit.observed.present.sum(axis=1)
    used = found.used
    return float(np.sqrt(square[used].sum() / count[used].sum())), np.sqrt(square.sum(axis=1) / count)


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
    first, last = used[:-HELD_OUT], used[-HELD_OUT:]
    if len(first) < FEWEST_FITTED:
        return None
    whole = fit.estimate
    try:
        start = replace(whole.state, C=whole.state.C[first])
        partial = estimate(fit.observed.part(first), start, fit.priors, whole.scales)
    except BadViewsError:
        return None
    H = mount_poses(fit.views.base_from_flange, fit.views.mount)[last]
    seen, C = fit.observed.part(last), whole.board_poses[last]
    C = fit_corners(seen, partial.state.camera, C, shape=partial.state.shape, robust=True).C
    pairs = all_pairs(H, C)
    indices = [fit.views.views[i].index for i in last]
    note = f"fit on {len(first)} views, all {len(pairs)} pairs inside the other {HELD_OUT} scored"
    return score_holdout(partial.state.X, pairs, indices, len(first), note)


def _remarks(fit: CellFit, solution: Solution, session: Explanation) -> tuple[Remark, ...]:
    found, arm = fit.estimate, solution.arm
    suspects = ", ".join(f"{index + 1} (P(outlier) {p:.2f})" for index, p in solution.suspects.items())
    offered = arm is not None and arm.result is not None and arm.result.offered
    systematic = (
        f"Robot residuals follow the posture: {arm.stated.size_mm if arm else 0.0:.2f} mm, "
        f"{arm.stated.size_mrad if arm else 0.0:.2f} mrad in the arm's links, or a bracket that bends. "
    ) + ("Use the corrected arm." if offered else "Have the arm calibrated, and stiffen the bracket.")
    said = (
        (session.reading is not Reading.AS_RECORDED, session.reading.value, explain_text(session, fit.views)),
        (bool(suspects), "suspect-views", f"Suspect views, down-weighted: {suspects}. Retake them."),
        (not found.converged, "not-converged", "The fit has not converged. Check the views, or take more."),
        (
            not fit.observed.has_pixels,
            "no-corners",
            "No corners were recorded: board poses count as exact, all error is the robot's.",
        ),
        (arm is not None and arm.stated.applied, "arm-systematics", systematic),
        (bool(fit.joints_note), "joints", fit.joints_note),
        (
            bool(fit.arm_failure),
            "arm-not-fitted",
            f"Errors of arm and bracket are left out, or some of them: a fit failed ({fit.arm_failure}).",
        ),
    )
    return tuple(Remark(code, text) for true, code, text in said if true)


def solve_paper_profile(views: ViewSet, options: SolveOptions) -> Solution:
    """Run the paper's experiment: consecutive pairs (eq. 21), the last 6 of them to score (eqs. 24-26)."""
    H, C = mount_poses(views.base_from_flange, views.mount), views.camera_from_board
    pairs = consecutive_pairs(H, C)
    held = HELD_OUT if options.holdout and len(pairs) >= HELD_OUT + 3 else 0
    fit = pairs.select(slice(0, len(pairs) - held))
    require_motion(fit)
    result = solve_paper(fit, options.seed)
    X, indices = result.X, [view.index for view in views]
    covariance = pair_covariance(result.objective, fit, X)
    distance = options.working_distance_m or median_distance_m(C)
    parent, _ = camera_frames(views.mount)
    certificate = _of_returned(build_objective(fit, "log", centre=X), X, len(fit))
    spread_m, spread_rad = board_spread(H, C, X)
    note = f"pairs {len(fit)} and {len(fit) + 1} share a pose, as in the paper"
    return Solution(
        mount=views.mount,
        profile="paper",
        parent_from_child=Transform(*camera_frames(views.mount), X),
        covariance=covariance,
        confidence_threshold=float(6 * special.fdtri(6, max(6 * len(fit) - 6, 1), 0.95)),
        board_place=Transform(*board_frames(views.mount), mean_pose(H @ X @ C)),
        camera=views.camera,
        rms_px=None,
        used=tuple(indices),
        rejected=(),
        certificate=certificate,
        observability=observe(fit, covariance, distance, parent),
        holdout=score_holdout(X, pairs.select(slice(len(fit), None)), indices, len(fit) + 1, note)
        if held
        else None,
        kept=views.views,
        coverage=picture_coverage(views.views, views.camera),
        lens_estimated=options.intrinsics_from_same_pictures,
        predicted_error_m=point_error_m(X, covariance, distance),
        working_distance_m=distance,
        board_spread_m=spread_m,
        board_spread_rad=spread_rad,
        on_box=result.on_box,
        warnings=_paper_warnings(result.on_box, held, certificate),
        seed=options.seed,
    )


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
