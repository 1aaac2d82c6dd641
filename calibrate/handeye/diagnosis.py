"""Diagnosis of an estimate: given lens and board, error sources, rejected views, cross-validation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import special

from calibrate.errors import BadViewsError
from calibrate.handeye.cell_fit import CellFit
from calibrate.handeye.cell_state import Layout
from calibrate.handeye.estimate import FULL, NEARLY_SETTLED, estimate
from calibrate.handeye.linear import Linear
from calibrate.handeye.metrics import point_error_m
from calibrate.handeye.solution import Finding
from calibrate.handeye.uncertainty import inverse_of
from calibrate.results import CrossValidation, RejectedView
from calibrate.views.projection import intrinsics_vector
from calibrate.views.view_set import Places, implied_flange
from recordings.geometry import Array, difference, skew

_LOOSER = 0.01
"""Factor on the information of a stated value to test what X is without it; 0 could leave X undetermined."""


def judge_lens(fit: CellFit, distance_m: float) -> Finding:
    """Compare the given lens with what the images and the robot's motion tell."""
    state, prior = fit.estimate.state, fit.priors.lens
    return _judge(
        fit, Layout.of(state).lens, intrinsics_vector(state.camera) - prior.mean, prior.sigma, distance_m
    )


def judge_board(fit: CellFit, distance_m: float) -> Finding:
    """Compare the stated board (size, equal scale in x and y, flatness) with what the views tell."""
    state = fit.estimate.state
    return _judge(fit, Layout.of(state).shape, state.shape, fit.priors.board.sigma, distance_m)


def _judge(fit: CellFit, places: slice, miss: Array, sigma: Array, distance_m: float) -> Finding:
    covariance = fit.estimate.covariance
    # If statement and views agree, the covariance of the difference of the estimates with and without the
    # statement is the difference of their covariances.
    root = 1.0 / sigma
    left = np.eye(len(sigma)) - covariance[places, places] * root * root[:, None]
    values, vectors = np.linalg.eigh((left + left.T) / 2)
    told = values > 1e-6  # what is left of smaller ones is rounding
    square = float(((vectors.T @ (miss * root))[told] ** 2 / values[told]).sum())
    sigmas = -float(special.ndtri(special.chdtrc(max(int(told.sum()), 1), square) / 2))
    precision = np.zeros(len(covariance))
    precision[places] = (1 - _LOOSER) * sigma**-2.0
    step = np.zeros(len(covariance))
    step[places] = precision[places] * miss
    try:
        moved = inverse_of(inverse_of(covariance) - np.diag(precision)) @ step
    except np.linalg.LinAlgError:
        moved = np.zeros(len(covariance))
    pull_m = point_error_m(fit.estimate.state.X, np.outer(moved[:6], moved[:6]), distance_m)
    error_m = point_error_m(fit.estimate.state.X, covariance[:6, :6], distance_m)
    return Finding(sigmas if told.any() else 0.0, pull_m, error_m)


def error_shares(fit: CellFit, common: Array) -> dict[str, float]:
    """Split X's variance by source into shares that sum to 1, mean over directions.

    The share of the lens is the variance that would vanish if it were known exactly, that of the board what
    would vanish besides if it were known, too, then that of the arm's errors. What is left is the noise of
    corners, robot translation and robot rotation.
    """
    covariance, at = fit.estimate.covariance, Layout.of(fit.estimate.state)
    whiten = np.linalg.inv(covariance[:6, :6] + common)
    shares = {}
    for name, part in (("intrinsics", at.lens), ("board", at.shape), ("kinematics", at.arm_errors)):
        known = covariance[:, part] @ np.linalg.pinv(covariance[part, part], hermitian=True)
        taken = known @ covariance[part]
        shares[name] = float(np.trace(whiten @ taken[:6, :6])) / 6
        covariance = covariance - taken
    shares["kinematics"] += float(np.trace(whiten @ common)) / 6
    noise = fit.estimate.noise_parts / fit.estimate.noise_parts.sum() * (1.0 - sum(shares.values()))
    return dict(zip(("corners", "robot_translation", "robot_rotation"), noise.tolist(), strict=True)) | shares


_COMPONENTS = ("x", "y", "z", "rotation about x", "rotation about y", "rotation about z")
_CHANCE = 1e-6
"""Probability of a residual this large by noise alone, below which noise is no explanation."""


def explain_views(fit: CellFit, places: Places) -> tuple[RejectedView, ...]:
    """Explain why each of the rejected views at `places` contradicts the others."""
    state = fit.estimate.state
    implied = implied_flange(fit.observed.mount, state.X, state.Y, fit.estimate.board_poses)
    return tuple(_explain(fit, implied[place], int(place), places) for place in places)


def _explain(fit: CellFit, implied: Array, place: int, places: Places) -> RejectedView:
    residual, covariance = fit.estimate.robot[place], fit.estimate.robot_covariance[place]
    view = fit.views.views[place]
    for other in places:
        if other == place:
            continue
        if _chance(difference(implied, fit.observed.flange[other]), covariance) > _CHANCE:
            owner = fit.views.views[other]
            text = f"The image belongs to the robot pose of view {owner.index + 1} ({owner.name})."
            return RejectedView(view.index, view.name, text, "wrong-pose", belongs_to=owner.index)
    if _chance(residual, covariance) < _CHANCE:
        for number in range(6):
            rest = np.delete(np.arange(6), number)
            inner = covariance[np.ix_(rest, rest)]
            if _chance(residual[rest], inner) > _CHANCE:
                gain = covariance[number, rest] @ np.linalg.solve(inner, residual[rest])
                slip = float(gain - residual[number])  # recorded minus true: `robot` is implied - recorded
                size = f"{slip * 1e3:.2f} mm" if number < 3 else f"{np.degrees(slip):.2f}°"
                text = f"Only {_COMPONENTS[number]} of the robot pose in base is off, by {size}."
                return RejectedView(
                    view.index, view.name, text, "wrong-number", wrong_number=number, slip=slip
                )
    shift, turn = np.linalg.norm(residual[:3]), np.linalg.norm(residual[3:])
    text = f"Robot pose and image differ by {shift * 1e3:.2f} mm, {np.degrees(turn):.2f}°."
    return RejectedView(view.index, view.name, text, "inconsistent")


def _chance(residual: Array, covariance: Array) -> float:
    return float(special.chdtrc(len(residual), residual @ np.linalg.solve(covariance, residual)))


FOLDS = 5
_CALLED_TOO_SMALL = 1e-4
"""Probability that a correct predicted error is reported as too small."""


def cross_validate(fit: CellFit, seed: int) -> CrossValidation | None:
    """Predict each view from the other folds; None with too few views, or where a fold determines nothing."""
    full = np.flatnonzero(fit.estimate.chances[:, 0] > FULL)
    if len(full) <= FOLDS:
        return None
    order = np.random.default_rng(seed).permutation(full)
    missed = np.zeros((len(fit.views), 6))
    claimed = np.zeros((len(fit.views), 6, 6))
    for k in range(FOLDS):
        left_out = np.sort(order[k::FOLDS])
        try:
            missed[left_out], claimed[left_out] = _predict(fit, left_out)
        except (BadViewsError, np.linalg.LinAlgError):
            return None
    T = _at_board(fit)
    missed, claimed = (T @ missed[..., None])[full, :, 0], (T @ claimed @ np.swapaxes(T, 1, 2))[full]
    distance = np.linalg.norm(missed[:, :3], axis=1)
    expected = np.trace(claimed[:, :3, :3], axis1=1, axis2=2)
    freedom = 3 * len(full)
    limit = float(np.sqrt(special.fdtri(freedom, max(freedom - 6, 1), 1 - _CALLED_TOO_SMALL)))
    return CrossValidation(
        rms_mm=1e3 * float(np.sqrt((distance**2).mean())),
        rms_deg=float(np.degrees(np.sqrt((missed[:, 3:] ** 2).sum(axis=1).mean()))),
        claimed_mm=1e3 * float(np.sqrt(expected.mean())),
        folds=FOLDS,
        limit=limit,
    )


def held_out_elsewhere(fit: CellFit, joints_rad: Array) -> Array | None:
    """Predict each view from views taken elsewhere: error (2, n) of the board's middle, metres.

    First row without, second with the arm's errors; NaN for views that do not count fully.
    joints_rad: (n, 6), split into FOLDS along their principal axis. None where a fold determines nothing.
    """
    full = np.flatnonzero(fit.estimate.chances[:, 0] > FULL)
    if len(full) < 2 * FOLDS:
        return None
    spread = joints_rad[full] - joints_rad[full].mean(axis=0)
    order = full[np.argsort(spread @ np.linalg.svd(spread)[2][0], kind="stable")]
    bare = replace(
        fit,
        estimate=replace(fit.plain, scales=replace(fit.estimate.scales, arm_error_sigma=np.zeros(0))),
        observed=replace(fit.observed, by_arm_errors=fit.observed.by_arm_errors[..., :0]),
    )
    missed = np.full((2, len(fit.views)), np.nan)
    for way, one in enumerate((bare, fit)):
        at_board = _at_board(one)
        for left_out in np.array_split(order, FOLDS):
            try:
                residual, _ = _predict(one, np.sort(left_out))
            except (BadViewsError, np.linalg.LinAlgError):
                return None
            off = (at_board[np.sort(left_out)] @ residual[..., None])[:, :3, 0]
            missed[way, np.sort(left_out)] = np.linalg.norm(off, axis=1)
    return missed


def _predict(fit: CellFit, left_out: Places) -> tuple[Array, Array]:
    """Compute residuals (m, 6) of the views left out, and their covariance (m, 6, 6) by the other views."""
    others = np.setdiff1d(np.arange(len(fit.views)), left_out)
    whole = fit.estimate
    start = replace(whole.state, C=whole.state.C[others])
    found = estimate(fit.observed.part(others), start, fit.priors, whole.scales, settled=NEARLY_SETTLED)
    seen = replace(found.state, C=whole.board_poses[left_out])
    linear = Linear.at(fit.observed.part(left_out), seen, whole.corner_weights[left_out])
    return linear.m, linear.predicted(found.scales, found.covariance)


def _at_board(fit: CellFit) -> Array:
    """Make matrices (n, 6, 6) from [δt, δφ] of the flange to that of the board's middle, in base."""
    state, observed = fit.estimate.state, fit.observed
    middle = np.array([*observed.extent[0], 0.0])
    board = state.Y if observed.mount == "eye-in-hand" else observed.flange @ state.Y
    point = np.broadcast_to(board[..., :3, :3] @ middle + board[..., :3, 3], (len(observed), 3))
    T = np.tile(np.eye(6), (len(observed), 1, 1))
    T[:, :3, 3:] = -skew(point - observed.flange[:, :3, 3])
    return T
