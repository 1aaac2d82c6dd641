"""The solver: views in, a `Solution` with uncertainty, checks and warnings out.

Where to find what, in the order of a solve; docs/contributor/solver.md has the equations:

    solve.py        `solve_views`: the fit, then what it says, and how the recording reads best
      cell_fit.py   `fit_cell`: from views to the estimate of a cell, by
        axxb/         the X of all pairs, proven; the paper's and other methods for A X = X B
        pose_fit.py   `agreed_start` where most views agree; `fit_poses`, a quick fit without corners
        estimate.py   `estimate`: Gauss-Newton over all unknowns (`cell_state.py`), each step by
          linear.py     `Linear`: the likelihood at one state, board poses eliminated: step and noise
                        (`reprojection.py`, `corner_modes.py`, `mixture.py`, `noise_scales.py`, `priors.py`)
        arm_fit.py    the same with errors of arm and bracket (`arm.py`), averaged over their sizes
        assumed_arm.py  a typical arm of its class, where nobody told the joints
      describe.py   the three parts of the answer (`solution.py`)
        stated_point.py, placed_point.py   the error of a point as the arm will place it
      readings.py   where the views disagree: the recording as it might be meant, by `fit_poses`
      diagnosis.py, metrics.py, uncertainty.py, arm_result.py, workspace.py    how good it is, and why
      posterior.py  what later checks begin with
    corner_fit.py   lens and board poses by the corners alone, before any solve
    paper_profile.py    the paper's experiment instead of all this
    peers.py        published methods beside it; information.py    what poses would tell
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibrate.errors import BadViewsError, PosesDisagreeError
from calibrate.handeye.assumed_arm import class_of_arm
from calibrate.handeye.blas_threads import one_blas_thread
from calibrate.handeye.board_motion import board_extent_m, boards_own_motion
from calibrate.handeye.cell_fit import CellFit, fit_cell
from calibrate.handeye.describe import describe
from calibrate.handeye.estimate import FULL
from calibrate.handeye.metrics import require_solvable
from calibrate.handeye.paper_profile import solve_paper_profile
from calibrate.handeye.pose_fit import pose_views
from calibrate.handeye.priors import LensPrior, Priors
from calibrate.handeye.readings import CHANGES, explain_changes, explain_recording, explain_text
from calibrate.handeye.solution import Explanation, Reading, Solution, SolveOptions
from calibrate.results import Remark
from calibrate.views.arrays import array_of
from calibrate.views.corners import Corners as Corners
from calibrate.views.projection import intrinsics_names
from calibrate.views.view_set import BoardView as BoardView
from calibrate.views.view_set import ViewSet as ViewSet

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
    of_class = class_of_arm(views, options.arm_class, options.robot_accuracy_m, options.robot_accuracy_rad)
    try:
        fit = fit_cell(views, priors, options.seed, of_class)
    except PosesDisagreeError as problem:
        session = explain_recording(
            poses, options.seed, unmirrored=options.unmirrored, pictured=_with_told_lens(views, options)
        )
        raise PosesDisagreeError(
            hypothesis=session.reading.value, **problem.values | {"advice": explain_text(session, views)}
        ) from None
    solution = describe(fit, options)
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
    warnings = _remarks(fit, solution, session)
    return replace(solution, judgement=replace(solution.judgement, session=session, warnings=warnings))


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
    judgement = solution.judgement
    folds = judgement.figures.cross_validation
    noise = solution.fit.noise
    findings = (judgement.lens_finding, judgement.board_finding)
    return bool(
        (folds is not None and folds.rms_mm > folds.limit * folds.claimed_mm)
        or any(finding is not None and finding.unexplained_m > 0 for finding in findings)
        or (noise is not None and (noise.robot_m > _NOISY_M or noise.robot_rad > _NOISY_RAD))
    )


def _remarks(fit: CellFit, solution: Solution, session: Explanation) -> tuple[Remark, ...]:
    found = fit.estimate
    arm = solution.fit.arm
    suspects = ", ".join(
        f"{index + 1} (P(outlier) {p:.2f})" for index, p in solution.evidence.suspects.items()
    )
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
