"""What is stated of a point that the arm will place: from a fit to `results.PointError`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibrate.handeye.arm import FLEX, ArmPostures, flex_motion, gravity_in_flange
from calibrate.handeye.cell_fit import CellFit
from calibrate.handeye.cell_state import Layout
from calibrate.handeye.estimate import Estimate
from calibrate.handeye.information import MORE_VIEWS
from calibrate.handeye.placed_point import (
    KnownErrors,
    PlacedPoint,
    Postures,
    farthest_tool_m,
    on_axis,
)
from calibrate.handeye.uncertainty import inverse_of
from calibrate.handeye.workspace import sample_around
from calibrate.results import PointError
from recordings.geometry import Array

_ENDLESS = 1e6
"""Times that every view is repeated where only what no view can lower is to be left."""


@dataclass(frozen=True, eq=False)
class _Basis:
    """The fit that a statement rests on, and the arm whose errors are in it."""

    estimate: Estimate
    by_arm_errors: Array
    """(n, 6, q + 9) of the used views."""
    flange: Array
    """(n, 4, 4) of the used views."""
    workspace: Postures | None
    """None where no kinematics say where else the arm may be."""
    arm: Literal["learned", "told", "assumed"]


def state_point(
    fit: CellFit, installed: Array, stated: Array, distance_m: float, corrected_mm: float | None = None
) -> PointError:
    """State the error of a point at `distance_m` on the camera's axis, for X̂ = `installed` (4, 4).

    stated: (6, 6) covariance of X by an accuracy of the robot that was told, where no arm stands for it; it
    counts to the arm's part. corrected_mm: the error by the corrected arm; None where none is offered.
    """
    basis = _basis(fit)
    found = basis.estimate
    recorded = recorded_postures(basis.flange, basis.by_arm_errors)
    point = on_axis(distance_m)
    known = known_errors(found, found.covariance)
    told = np.zeros_like(known.covariance)
    told[:6, :6] = stated
    known = replace(known, covariance=known.covariance + told)
    at_recorded = PlacedPoint.of(fit.views.mount, known, installed, point, recorded)
    square = at_recorded.mean_square(known.covariance, known.noise)
    workspace = square
    if basis.workspace is not None:
        tool_m = farthest_tool_m(fit.views.mount, installed, point, basis.flange)
        elsewhere = PlacedPoint.of(fit.views.mount, known, installed, point, basis.workspace, tool_m)
        workspace = elsewhere.mean_square(known.covariance, known.noise)

    def with_views_times(factor: float) -> float:
        covariance = known_errors(found, _with_views_times(fit, found, factor)).covariance + told
        return min(at_recorded.mean_square(covariance, known.noise), square)

    used = max(int(found.used.sum()), 1)
    lens_and_board = _taken_by(found, [Layout.of(found.state).lens, Layout.of(found.state).shape])
    left = known.covariance - told - lens_and_board
    arm_only = _explained(left, slice(6, len(left)))
    by_lens_and_board = at_recorded.by_uncertainty(lens_and_board)
    by_x = at_recorded.by_uncertainty(left - arm_only)
    by_arm = square - by_lens_and_board - by_x
    return PointError(
        error_mm=_mm(square),
        at_m=distance_m,
        p95_mm=1e3 * at_recorded.bound_m(known),
        workspace_mm=_mm(workspace),
        from_x_mm=_mm(by_x),
        from_arm_mm=_mm(by_arm),
        from_board_lens_mm=_mm(by_lens_and_board),
        floor_mm=_mm(with_views_times(_ENDLESS)),
        with_more_views_mm=_mm(with_views_times(1 + MORE_VIEWS / used)),
        arm="told" if fit.accuracy_told else basis.arm,
        arm_class="" if basis.arm != "assumed" or fit.accuracy_told else fit.of_class.name,
        corrected_mm=corrected_mm,
    )


def corrected_error_mm(fit: CellFit, arm: ArmPostures, distance_m: float) -> float:
    """Compute the error by flanges of the corrected arm, beside the X of the fit."""
    found = fit.estimate
    count = len(arm.chain.link_errors)
    used = found.used
    known = known_errors(found, found.covariance)
    errors = known.errors.copy()
    errors[:count] = 0.0
    corrected = arm.chain.with_errors(known.errors[:count]).forward(arm.joints_rad[used])
    postures = recorded_postures(corrected, fit.observed.by_arm_errors[used])
    point = PlacedPoint.of(
        fit.views.mount, replace(known, errors=errors), found.state.X, on_axis(distance_m), postures
    )
    return _mm(point.mean_square(known.covariance, known.noise))


def uncorrected_error_mm(fit: CellFit, installed: Array, distance_m: float) -> float:
    """Compute the error by the controller's flanges, beside X̂ = `installed` (4, 4)."""
    found = fit.estimate
    known = known_errors(found, found.covariance)
    postures = recorded_postures(
        fit.views.base_from_flange[found.used], fit.observed.by_arm_errors[found.used]
    )
    point = PlacedPoint.of(fit.views.mount, known, installed, on_axis(distance_m), postures)
    return _mm(point.mean_square(known.covariance, known.noise))


def recorded_postures(flange: Array, by_arm_errors: Array) -> Postures:
    """Part the motion (n, 6, q + b) by errors of arm and bracket: a bracket's are the last."""
    count = max(by_arm_errors.shape[2] - len(FLEX), 0)
    return Postures(flange, by_arm_errors[..., :count], by_arm_errors[..., count:])


def _basis(fit: CellFit) -> _Basis:
    flanges = fit.views.base_from_flange
    gravity = gravity_in_flange(flanges).mean(axis=0)
    if fit.arm is not None:
        used = fit.estimate.used
        return _Basis(
            estimate=fit.estimate,
            by_arm_errors=fit.observed.by_arm_errors[used],
            flange=flanges[used],
            workspace=workspace_postures(fit.arm, gravity),
            arm="learned" if fit.arm.recorded else "told",
        )
    if fit.assumed is not None:
        places = fit.assumed.places
        return _Basis(
            estimate=fit.assumed.estimate,
            by_arm_errors=fit.assumed.observed.by_arm_errors[places],
            flange=flanges[places],
            workspace=workspace_postures(fit.assumed.arm, gravity),
            arm="assumed",
        )
    used = fit.estimate.used
    return _Basis(fit.estimate, fit.observed.by_arm_errors[used], flanges[used], None, "assumed")


def workspace_postures(arm: ArmPostures, mean_gravity: Array) -> Postures:
    """Draw postures where the arm may work next.

    mean_gravity: (3,) of the recorded views, in the flange: what a bracket bends there belongs to X.
    """
    joints = sample_around(arm.chain, arm.joints_rad)
    flange = arm.chain.forward(joints)
    return Postures(flange, arm.chain.by_links(joints), flex_motion(flange, mean_gravity))


def known_errors(found: Estimate, covariance: Array) -> KnownErrors:
    """Return what a fit knows of X and the arm's errors; covariance: (G, G) as that of the fit, or less."""
    errors = Layout.of(found.state).arm_errors
    places = np.append(np.arange(6), np.arange(errors.start, errors.stop))
    return KnownErrors(
        X=found.state.X,
        errors=found.state.arm_errors,
        covariance=covariance[np.ix_(places, places)],
        noise=found.scales.robot,
        freedom=found.freedom,
    )


def _with_views_times(fit: CellFit, found: Estimate, factor: float) -> Array:
    """Compute the covariance (G, G) if every view had been taken `factor` times.

    What the views tell is what is known less what was known before them.
    """
    before = fit.priors.linearise(found.state, found.scales.arm_error_sigma).N
    values, vectors = np.linalg.eigh(inverse_of(found.covariance) - before)
    by_views = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return inverse_of(before + factor * by_views)


def _taken_by(found: Estimate, parts: list[slice]) -> Array:
    """Compute the part (6 + q, 6 + q) of the covariance of [X, errors] that knowing `parts` takes away."""
    covariance = found.covariance
    taken = np.zeros_like(covariance)
    for part in parts:
        taken = taken + _explained(covariance - taken, part)
    return known_errors(found, taken).covariance


def _explained(covariance: Array, part: slice) -> Array:
    known = covariance[:, part] @ np.linalg.pinv(covariance[part, part], hermitian=True)
    return np.asarray(known @ covariance[part])


def _mm(square_m: float) -> float:
    return 1e3 * float(np.sqrt(max(square_m, 0.0)))
