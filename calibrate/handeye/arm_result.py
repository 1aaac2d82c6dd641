"""The arm's fitted kinematic table as a result: whether it is offered, its accuracy, its verification."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibrate.errors import BadViewsError
from calibrate.geometry import Array, difference, inverse, perturb
from calibrate.handeye.arm import ArmPostures, corrected_model
from calibrate.handeye.cell_state import Layout
from calibrate.handeye.corner_fit import fit_corners
from calibrate.handeye.estimate import CellFit
from calibrate.handeye.solution import (
    Solution,
    TableRefusal,
    TableResult,
    UncorrectedArm,
    Verification,
)
from calibrate.handeye.workspace import SPREAD, Workspace, sample_range, sample_workspace
from calibrate.kinematics import forward
from calibrate.results import SHAPE
from calibrate.views import BoardView, ViewSet, observe_views

_NOMINAL_M = 1e-4
"""Above this rms distance (m) the recorded flanges were not computed with the nominal table."""


def arm_results(
    fit: CellFit, arm: ArmPostures, detected: bool, distance_m: float, missed: Array | None
) -> tuple[UncorrectedArm, TableResult | None]:
    """Derive from a fit the X for the arm as it is, and the corrected table where it follows a known one.

    missed: (2, n), as `TableResult.held_out_m`.
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
    if table is None:
        return uncorrected, None
    return uncorrected, TableResult(
        nominal=table,
        factory=fit.views.arm is not None,
        corrected=corrected_model(table, errors),
        covariance=covariance,
        with_table_m=corrected_m,
        held_out_m=missed,
        refused=_refusal(fit, arm, detected, missed),
    )


_ELSEWHERE_RAD = 0.1
"""A view counts as taken elsewhere when some joint differs by this much from every view of the fit."""
_FEWEST_ELSEWHERE = 5


def verify_elsewhere(solution: Solution, views: ViewSet, recording: str = "") -> Verification:
    """Verify X and the arm's table with views of the same board that took no part in the fit.

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
        (forward(arm.corrected, joints), solution.matrix),
    ):
        chain = flange @ X @ C if views.mount == "eye-in-hand" else inverse(flange) @ X @ C
        at = (chain @ middle)[:, :3]
        missed.append(np.linalg.norm(at - at.mean(axis=0), axis=1))
    return Verification(recording, views.base_from_flange[:, :3, 3], np.array(missed))


def _stands_elsewhere(view: BoardView, fitted: Sequence[Array]) -> bool:
    if view.joints_rad is None:
        return False
    return all(np.abs(view.joints_rad - joints).max() > _ELSEWHERE_RAD for joints in fitted)


def _refusal(fit: CellFit, arm: ArmPostures, detected: bool, missed: Array | None) -> TableRefusal | None:
    if not detected:
        return "no-evidence"
    if not arm.recorded:
        return "no-joints"
    off = difference(arm.chain.forward(arm.joints_rad), fit.views.base_from_flange)[:, :3]
    if np.sqrt(np.mean((off**2).sum(axis=1))) > max(_NOMINAL_M, 3 * float(fit.estimate.scales.robot[0])):
        return "not-nominal"
    if missed is not None and not np.nanmean(missed[1] ** 2) < np.nanmean(missed[0] ** 2):
        return "not-better"
    return None
