"""The corrected arm as a result: whether it is offered, and its accuracy."""

from __future__ import annotations

import numpy as np

from calibrate.geometry import Array, difference, perturb
from calibrate.handeye.arm import ArmPostures
from calibrate.handeye.cell_fit import CellFit
from calibrate.handeye.cell_state import Layout
from calibrate.handeye.solution import ArmRefusal, ArmResult, UncorrectedArm
from calibrate.handeye.workspace import SPREAD, Workspace, sample_range, sample_workspace

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


def _refusal(fit: CellFit, arm: ArmPostures, detected: bool, missed: Array | None) -> ArmRefusal | None:
    if not detected:
        return "no-evidence"
    if not arm.recorded:
        return "no-joints"
    off = difference(arm.chain.forward(arm.joints_rad), fit.views.base_from_flange)[:, :3]
    if np.sqrt(np.mean((off**2).sum(axis=1))) > max(_NOMINAL_M, 3 * float(fit.estimate.scales.robot[0])):
        return "not-nominal"
    if missed is not None:
        as_it_is, corrected = np.nanmean(missed**2, axis=1)
        return None if corrected < as_it_is else "not-better"
    return None
