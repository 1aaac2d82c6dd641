"""Cross-validation: each view predicted by an estimate that never saw it, against what that one claims."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from calibrate.errors import BadViewsError
from calibrate.geometry import Array, skew
from calibrate.handeye.estimate import FULL, estimate
from calibrate.handeye.fit import CellFit
from calibrate.handeye.linear import Linear
from calibrate.handeye.observations import Places

FOLDS = 5
FEWEST_VIEWS = 6
_STEPS = 3
"""Linearisations of each fold: it starts from the estimate of all views."""
_CHANCE = 1e-4
"""That sound claims are called too small."""


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Of the views that count fully, at the middle of the board."""

    rms_m: float
    rms_rad: float
    claimed_m: float
    """The same as the estimates predict it."""
    limit: float
    """Of `rms_m` over `claimed_m`; beyond it the claim is too small."""
    folds: int
    residual_m: dict[int, float]
    """Place of each view → distance by which it was missed."""


def cross_validate(fit: CellFit, seed: int) -> CrossValidation | None:
    """None with too few views, or where a fold determines nothing."""
    full = np.flatnonzero(fit.estimate.chances[:, 0] > FULL)
    if len(full) < FEWEST_VIEWS:
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
    limit = float(np.sqrt(stats.f.isf(_CHANCE, freedom, max(freedom - 6, 1))))
    return CrossValidation(
        float(np.sqrt((distance**2).mean())),
        float(np.sqrt((missed[:, 3:] ** 2).sum(axis=1).mean())),
        float(np.sqrt(expected.mean())),
        limit,
        FOLDS,
        dict(zip(full.tolist(), distance.tolist(), strict=True)),
    )


def _predict(fit: CellFit, left_out: Places) -> tuple[Array, Array]:
    """Residuals (m, 6) of the views left out, and the covariance (m, 6, 6) that the other views give them."""
    others = np.setdiff1d(np.arange(len(fit.views)), left_out)
    whole = fit.estimate
    start = whole.state.of_views(others)
    found = estimate(fit.observed.part(others), start, fit.priors, whole.scales, max_steps=_STEPS)
    seen = found.state.with_boards(whole.board_poses[left_out])
    linear = Linear.at(fit.observed.part(left_out), seen, whole.corner_weights[left_out])
    return linear.m, linear.predicted(found.scales, found.covariance)


def _at_board(fit: CellFit) -> Array:
    """(n, 6, 6) from [δt, δφ] of the flange to that of the middle of the board, in base."""
    state, observed = fit.estimate.state, fit.observed
    middle = np.array([*observed.extent[0], 0.0])
    _, Y = state.poses(observed)
    board = Y if observed.mount == "eye-in-hand" else observed.flange @ Y
    point = np.broadcast_to(board[..., :3, :3] @ middle + board[..., :3, 3], (len(observed), 3))
    T = np.tile(np.eye(6), (len(observed), 1, 1))
    T[:, :3, 3:] = -skew(point - observed.flange[:, :3, 3])
    return T
