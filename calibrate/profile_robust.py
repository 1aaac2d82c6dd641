"""`--profile robust`: certain first estimate, then what makes it precise and honest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate.assess import (
    board_spread,
    distance_in_sigmas,
    median_distance_m,
    observe,
    point_error_m,
    require_motion,
    score_holdout,
)
from calibrate.board_poses import refine_board_poses
from calibrate.consensus import pose_arrays
from calibrate.errors import BadViewsError, PosesDisagreeError
from calibrate.estimate import Estimate, estimate, first_state
from calibrate.fit import Fit, Settled, fit_views
from calibrate.frame_check import check_frames
from calibrate.frames import board_frames, camera_frames
from calibrate.geometry import Transform
from calibrate.lens_check import check_lens
from calibrate.likelihood.model import observe_views
from calibrate.likelihood.residuals import corner_residuals, robot_residuals
from calibrate.misread import what_to_mend
from calibrate.pair_covariance import pair_covariance
from calibrate.pairs import all_pairs
from calibrate.solution import ErrorBudget, HoldoutScore, NoiseScales, Solution, SolveOptions
from calibrate.stopwatch import Stopwatch
from calibrate.views import ViewSet

HELD_OUT = 6
"""Views kept for the score: fit on the first 19 of 25."""


def solve_robust_profile(views: ViewSet, options: SolveOptions) -> Solution:
    """All views to fit; a second fit without the last 6 for the hold-out score."""
    watch = Stopwatch()
    free = options.intrinsics_from_same_pictures and views.camera.distortion_model == "plumb_bob"
    try:
        fit = fit_views(views, options.seed, free, options.reject_outliers, watch, options.kinematic_prior)
    except PosesDisagreeError as problem:
        raise BadViewsError(f"{problem} {what_to_mend(views, options.seed)}") from None
    settled = fit.settled
    result, state, places = settled.estimate, settled.estimate.state, settled.places
    parent, child = camera_frames(views.mount)
    H, _ = pose_arrays(fit.views)
    C = settled.boards.C
    distance = options.working_distance_m or median_distance_m(C[places])
    spread_m, spread_rad = board_spread(H[places], C[places], state.X)
    pairs, start = fit.pairs, fit.certified
    apart = distance_in_sigmas(start.X, state.X, pair_covariance(start.objective, pairs, start.X))
    lens_finding = "" if free else check_lens(settled.observed, result)
    watch.lap("lens check")
    # A kinematic table found wrong accounts for such a turn itself.
    worn = fit.systematics is not None and fit.systematics.detected
    frames_finding = (
        "" if worn else check_frames(settled.everything.part(places), replace(state, C=C[places]))
    )
    holdout = _holdout(fit, free) if options.holdout else None
    watch.lap("hold-out")
    indices = [view.index for view in fit.views]
    in_doubt = {indices[place]: chance for place, chance in settled.doubts.items()}
    return Solution(
        mount=views.mount,
        profile="robust",
        parent_from_child=Transform(parent, child, state.X),
        covariance=result.covariance,
        confidence_threshold=result.threshold,
        board_place=Transform(*board_frames(views.mount), state.Y),
        camera=state.camera,
        rms_px=_rms_px(settled),
        used=tuple(indices[i] for i in places),
        rejected=fit.rejected,
        certificate=replace(start.certificate, distance_sigma=apart),
        observability=observe(pairs, result.covariance, distance, parent),
        holdout=holdout,
        kept=tuple(fit.views.views[i] for i in places),
        turned=tuple(indices[i] for i in sorted(fit.consensus.turned)),
        noise=NoiseScales(*(float(s) for s in result.sigma[:3])),
        systematics=fit.systematics,
        budget=ErrorBudget(**result.shares),
        predicted_error_m=point_error_m(state.X, result.covariance, distance),
        working_distance_m=distance,
        board_spread_m=spread_m,
        board_spread_rad=spread_rad,
        residual_px={indices[i]: float(settled.boards.rms_px[i]) for i in places},
        residual_robot=_robot_misses(settled, indices),
        frames_finding=frames_finding,
        in_doubt=in_doubt,
        warnings=_warnings(fit, options, result, in_doubt, (lens_finding, frames_finding)),
        stage_ms=watch.stage_ms,
        solve_ms=watch.total_ms,
        seed=options.seed,
    )


def _holdout(fit: Fit, intrinsics_free: bool) -> HoldoutScore | None:
    """Fit on all but the last 6 kept views, lens included; score all pairs inside those 6.

    That fit starts at the X of all views: a start decides how long the way to its own optimum is, not where
    the optimum lies.
    """
    kept = fit.views.select(fit.settled.places.tolist())
    fitted = len(kept) - HELD_OUT
    if fitted < 5:
        return None
    first = kept.select(list(range(fitted)))
    last = kept.select(list(range(fitted, len(kept))))
    H, C = pose_arrays(first)
    require_motion(all_pairs(H, C))
    observed = observe_views(first)
    start = first_state(observed, fit.settled.estimate.state.X, C, H, first.camera)
    partial = estimate(observed, start, intrinsics_free).state
    H, C = pose_arrays(last)
    boards = refine_board_poses(observe_views(last), replace(partial, C=C))
    pairs = all_pairs(H, boards.C)
    note = f"fit on {fitted} views, all {len(pairs)} pairs inside the other {HELD_OUT} scored"
    return score_holdout(partial.X, pairs, [view.index for view in last], fitted, note)


def _rms_px(settled: Settled) -> float | None:
    """Over all corners of the fitted views, bad ones included with their weight."""
    if not settled.observed.has_pixels:
        return None
    square = (corner_residuals(settled.observed, settled.estimate.state) ** 2).sum(axis=-1)
    weights = settled.estimate.weights
    return float(np.sqrt((weights * square).sum() / weights.sum()))


def _robot_misses(settled: Settled, indices: list[int]) -> dict[int, tuple[float, float]]:
    e = robot_residuals(settled.observed, settled.estimate.state)
    return {
        indices[i]: (float(np.linalg.norm(row[:3])), float(np.linalg.norm(row[3:])))
        for i, row in zip(settled.fitted.tolist(), e, strict=True)
        if i in settled.places
    }


def _warnings(
    fit: Fit,
    options: SolveOptions,
    result: Estimate,
    in_doubt: dict[int, float],
    findings: tuple[str, ...],
) -> tuple[str, ...]:
    warnings = [finding for finding in findings if finding]
    if options.intrinsics_from_same_pictures and not result.intrinsics_free:
        warnings.append(
            "The intrinsics came from the same pictures but could not be refined with X (only the plumb_bob "
            "model can): their uncertainty is not in the stated sigma."
        )
    if in_doubt:
        chances = ", ".join(f"{index + 1} ({chance:.0%})" for index, chance in in_doubt.items())
        warnings.append(
            f"In doubt, so counted in part: view {chances}, in brackets how likely it is wrong. "
            "Retake to be sure."
        )
    if not result.converged:
        warnings.append(f"The final estimate had not settled after {result.steps} steps.")
    if not fit.certified.certificate.certified:
        warnings.append("The global optimum of the pair objective could not be certified.")
    if not fit.settled.observed.has_pixels:
        warnings.append("No corners were recorded: board poses are taken as exact, all error is the robot's.")
    if fit.systematics is not None and fit.systematics.detected:
        warnings.append(fit.systematics.text)
    return tuple(warnings)
