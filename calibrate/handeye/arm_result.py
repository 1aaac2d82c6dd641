"""The corrected arm as a result: whether it is offered, its accuracy, its verification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibrate.errors import BadViewsError
from calibrate.geometry import Array, difference, inverse, perturb
from calibrate.handeye.arm import ArmPostures
from calibrate.handeye.cell_state import Layout
from calibrate.handeye.corner_fit import fit_corners
from calibrate.handeye.estimate import CellFit
from calibrate.handeye.solution import ArmRefusal, ArmResult, Solution, UncorrectedArm
from calibrate.handeye.workspace import SPREAD, Workspace, sample_range, sample_workspace
from calibrate.results import SHAPE
from calibrate.views import BoardView, ViewSet, observe_views

_NOMINAL_M = 1e-4
"""Above this rms distance (m) the recorded flanges were not computed with the nominal arm."""


def arm_results(
    fit: CellFit, arm: ArmPostures, detected: bool, distance_m: float, missed: Array | None
) -> tuple[UncorrectedArm, ArmResult]:
    """Derive from a fit the X for the arm as it is, and the corrected arm.

    missed: (2, n), as `ArmResult.held_out_m`.
    """
    found, state, chain, table = fit.estimate, fit.estimate.state, arm.chain, arm.table
    count = len(chain.link_errors)
    errors = state.arm_errors[:count]
    places = np.append(np.arange(6), Layout.of(state).arm_errors.start + np.arange(count))
    covariance = found.covariance[np.ix_(places, places)]
    joints = sample_range(arm.joints_rad) if table is None else sample_workspace(table, arm.joints_rad)

    def over(q: Array, spread: Array) -> Workspace:
        return Workspace.of(
            fit.views.mount, chain.forward(q), chain.by_links(q), state.X, state.Y, distance_m, spread
        )

    room = over(joints, SPREAD[:1])
    by_errors = (over(joints, SPREAD) + over(arm.joints_rad, SPREAD)).for_uncorrected()
    both = np.concatenate([np.eye(6), by_errors], axis=1)
    corrected_m = room.rms_m(covariance)
    left_m = room.error_m(by_errors @ errors, errors)
    uncorrected = UncorrectedArm(
        perturb(state.X, by_errors @ errors), both @ covariance @ both.T, float(np.hypot(corrected_m, left_m))
    )
    return uncorrected, ArmResult(
        nominal=chain,
        corrected=chain.with_errors(errors),
        table=table,
        factory=fit.views.arm is not None,
        joints_rad=np.array([arm.joints_rad.min(axis=0), arm.joints_rad.max(axis=0)]),
        covariance=covariance,
        error_m=corrected_m,
        held_out_m=missed,
        refused=_refusal(fit, arm, detected, missed),
    )


_ELSEWHERE_RAD = 0.1
"""A view counts as taken elsewhere when some joint differs by this much from every view of the fit."""
_FEWEST_ELSEWHERE = 5


def verify_elsewhere(solution: Solution, views: ViewSet, recording: str = "") -> Solution:
    """Verify X and the corrected arm with views of the same board that took no part in the fit.

    The board may lie anywhere but must not move: every view should place its middle at one point of base (or
    of the flange). Views from the postures of the fit are left out. Raises BadViewsError where too few are
    left or have joints.
    """
    found = solution.arm
    arm = None if found is None else found.result
    if arm is None or found is None or found.uncorrected is None:
        raise BadViewsError("no-arm-table")
    fitted = [view.joints_rad for view in solution.kept if view.joints_rad is not None]
    far = [place for place, view in enumerate(views) if _stands_elsewhere(view, fitted)]
    if len(far) < _FEWEST_ELSEWHERE:
        raise BadViewsError("not-elsewhere", views=len(far), recorded=len(views), minimum=_FEWEST_ELSEWHERE)
    views, shape = views.select(far), solution.board
    observed = observe_views(views)
    numbers = np.zeros(len(SHAPE)) if shape is None else shape.numbers
    C = fit_corners(observed, solution.camera, views.camera_from_board, shape=numbers, robust=True).C
    joints = np.array([view.joints_rad for view in views], dtype=float)
    middle = np.array([*observed.extent[0], 0.0, 1.0])
    missed = []
    for flange, X in (
        (views.base_from_flange, found.uncorrected.X),
        (arm.corrected.forward(joints), solution.matrix),
    ):
        chain = flange @ X @ C if views.mount == "eye-in-hand" else inverse(flange) @ X @ C
        at = (chain @ middle)[:, :3]
        missed.append(np.linalg.norm(at - at.mean(axis=0), axis=1))
    missed_m = np.array(missed)
    refused = arm.refused or (None if _helps(missed_m) else "not-better")
    result = replace(arm, verified_by=recording, verified_m=missed_m, refused=refused)
    return replace(solution, arm=replace(found, result=result))


def _helps(missed_m: Array) -> bool:
    """Tell whether the corrected arm misses less than the arm as it is; (2, n), NaN: unknown."""
    as_it_is, corrected = np.nanmean(missed_m**2, axis=1)
    return bool(corrected < as_it_is)


def _stands_elsewhere(view: BoardView, fitted: Sequence[Array]) -> bool:
    if view.joints_rad is None:
        return False
    return all(np.abs(view.joints_rad - joints).max() > _ELSEWHERE_RAD for joints in fitted)


def _refusal(fit: CellFit, arm: ArmPostures, detected: bool, missed: Array | None) -> ArmRefusal | None:
    if not detected:
        return "no-evidence"
    if not arm.recorded:
        return "no-joints"
    off = difference(arm.chain.forward(arm.joints_rad), fit.views.base_from_flange)[:, :3]
    if np.sqrt(np.mean((off**2).sum(axis=1))) > max(_NOMINAL_M, 3 * float(fit.estimate.scales.robot[0])):
        return "not-nominal"
    if missed is not None and not _helps(missed):
        return "not-better"
    return None
