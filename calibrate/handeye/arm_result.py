"""The corrected arm as a result: whether it is offered, and its accuracy."""

from __future__ import annotations

import numpy as np

from calibrate.arms.kinematics import DhTable, table_of_axes
from calibrate.handeye.arm import ArmPostures
from calibrate.handeye.arm_table import CorrectedArm, FramePose, HeldOutViews
from calibrate.handeye.cell_fit import CellFit
from calibrate.handeye.cell_state import Layout
from calibrate.handeye.solution import UncorrectedArm, camera_frames
from calibrate.handeye.stated_point import corrected_error_mm, uncorrected_error_mm
from calibrate.handeye.uncorrected_arm import uncorrected_arm
from recordings.geometry import Array, Transform, difference

_NOMINAL_M = 1e-4
"""Above this rms distance (m) the recorded flanges were not computed with the nominal arm."""


def arm_results(
    fit: CellFit, arm: ArmPostures, detected: bool, distance_m: float, missed: Array | None
) -> tuple[UncorrectedArm, CorrectedArm]:
    """Derive from a fit the X for the arm as it is, and the corrected arm.

    missed: (2, n) error, m, of views predicted from those taken elsewhere, by the arm as it is and by the
    corrected one; NaN: none.
    """
    found, state, chain, table = fit.estimate, fit.estimate.state, arm.chain, arm.table
    count = len(chain.link_errors)
    errors = state.arm_errors[:count]
    places = np.append(np.arange(6), Layout.of(state).arm_errors.start + np.arange(count))
    covariance = found.covariance[np.ix_(places, places)]
    uncorrected = uncorrected_arm(fit, arm, distance_m)
    refused, corrected = _refusal(fit, arm, detected, missed), chain.with_errors(errors)
    offered = not refused
    true = None
    if table is not None and offered:
        true = DhTable.of(table_of_axes(table, corrected.axes, corrected.points, corrected.flange))
    parent, child = camera_frames(fit.views.mount)
    return uncorrected, CorrectedArm(
        offered=offered,
        model="" if table is None else table.name,
        nominal_source="learned" if table is None else "published" if fit.views.arm is None else "factory",
        covariance=tuple(tuple(row) for row in covariance.tolist()),
        with_table_mm=corrected_error_mm(fit, arm, distance_m),
        without_table_mm=uncorrected_error_mm(fit, uncorrected.X, distance_m),
        nominal=None if table is None else DhTable.of(table),
        learned=chain.plain if table is None else None,
        joints_rad=[(min(q), max(q)) for q in arm.joints_rad.T.tolist()],
        held_out=None if missed is None else _held_out(missed),
        refused=refused,
        corrected=true,
        corrected_chain=corrected.plain if table is None and offered else None,
        result=FramePose.of(Transform(f"corrected_{parent}", child, state.X)) if offered else None,
    )


def _held_out(missed: Array) -> HeldOutViews:
    """Sum up errors (2, n), NaN: none, of the arm as it is and of the corrected one."""
    as_it_is, corrected = (1e3 * np.sqrt(np.nanmean(missed**2, axis=1))).tolist()
    return HeldOutViews(as_it_is, corrected, int(np.isfinite(missed[0]).sum()))


def _refusal(fit: CellFit, arm: ArmPostures, detected: bool, missed: Array | None) -> str:
    """Say why the corrected arm is not offered, as `CorrectedArm.refused`."""
    if not detected:
        return "no-evidence"
    if not arm.recorded:
        return "no-joints"
    off = difference(arm.chain.forward(arm.joints_rad), fit.views.base_from_flange)[:, :3]
    if np.sqrt(np.mean((off**2).sum(axis=1))) > max(_NOMINAL_M, 3 * float(fit.estimate.scales.robot[0])):
        return "not-nominal"
    if missed is not None:
        as_it_is, corrected = np.nanmean(missed**2, axis=1)
        return "" if corrected < as_it_is else "not-better"
    return ""
