"""What was stated of lens and board against what the views say, by what it does to X at a distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from calibrate.geometry import Array, skew
from calibrate.handeye.fit import CellFit
from calibrate.handeye.linear import inverse_of
from calibrate.handeye.observations import Layout
from calibrate.projection import intrinsics_vector

_EXPLAINED = 4.0
"""Sigmas of a statement's own tolerance within which views may differ from it."""
_LOOSER = 0.01
"""A statement is taken back by giving its information this factor, not none: without it X may be open."""


@dataclass(frozen=True, eq=False)
class Finding:
    """One statement (the lens, the board) against the views."""

    sigmas: float
    """By which views and statement contradict each other, as those of one normal number."""
    pull_m: float
    """By which believing the statement moves X at the working distance."""

    @property
    def unexplained_m(self) -> float:
        """The part of `pull_m` that the statement's tolerance does not explain."""
        return float(self.pull_m * np.maximum(0.0, 1.0 - _EXPLAINED / np.maximum(self.sigmas, 1e-9)))


def judge_lens(fit: CellFit, distance_m: float) -> Finding:
    """A given lens against its pictures and the robot's motion."""
    state, prior = fit.estimate.state, fit.priors.lens
    places = np.arange(Layout.of(state).lens.start, Layout.of(state).lens.stop)
    return _judge(fit, places, intrinsics_vector(state.camera) - prior.mean, prior.sigma, distance_m)


def judge_board(fit: CellFit, distance_m: float) -> Finding:
    """The stated board (size, equal print, flatness) against the views."""
    state = fit.estimate.state
    places = np.arange(Layout.of(state).shape.start, Layout.of(state).shape.stop)
    return _judge(fit, places, state.shape, fit.priors.board_sigma, distance_m)


def _judge(fit: CellFit, places: Array, miss: Array, sigma: Array, distance_m: float) -> Finding:
    covariance = fit.estimate.covariance
    # Where both agree, the difference of the estimates has the difference of their covariances.
    root = 1.0 / sigma
    left = np.eye(len(places)) - covariance[np.ix_(places, places)] * root * root[:, None]
    values, vectors = np.linalg.eigh((left + left.T) / 2)
    told = values > 1e-3
    square = float(((vectors.T @ (miss * root))[told] ** 2 / values[told]).sum())
    log_chance = float(stats.chi2.logsf(square, max(int(told.sum()), 1)))
    if log_chance < -600:
        sigmas = float(np.sqrt(-2 * log_chance))
    else:
        sigmas = float(stats.norm.isf(np.exp(log_chance) / 2))
    precision = np.zeros(len(covariance))
    precision[places] = (1 - _LOOSER) * sigma**-2.0
    step = np.zeros(len(covariance))
    step[places] = precision[places] * miss
    try:
        moved = inverse_of(inverse_of(covariance) - np.diag(precision)) @ step
    except np.linalg.LinAlgError:
        moved = np.zeros(len(covariance))
    lever = fit.estimate.state.X[:3, :3] @ np.array([0.0, 0.0, distance_m])
    J = np.concatenate([np.eye(3), -skew(lever)], axis=1)
    return Finding(sigmas if told.any() else 0.0, float(np.linalg.norm(J @ moved[:6])))


def error_shares(fit: CellFit) -> dict[str, float]:
    """Share of X's variance by source, mean over directions, summing to 1.

    Of lens, board shape and arm: what knowing them would take away; the rest by whose noise it is.
    """
    state, covariance = fit.estimate.state, fit.estimate.covariance
    at = Layout.of(state)
    whiten = np.linalg.inv(covariance[:6, :6])
    shares = {}
    for name, part in (("intrinsics", at.lens), ("board", at.shape), ("kinematics", at.table)):
        cross, inner = covariance[:6, part], covariance[part, part]
        taken = cross @ np.linalg.pinv(inner, hermitian=True) @ cross.T if inner.size else np.zeros((6, 6))
        shares[name] = float(np.trace(whiten @ taken)) / 6
    modelled = min(sum(shares.values()), 0.99)
    shares = {name: share * modelled / max(sum(shares.values()), 1e-12) for name, share in shares.items()}
    corners, translation, rotation = fit.estimate.noise_parts.tolist()
    total = corners + translation + rotation
    left = 1.0 - modelled
    return {
        "corners": left * corners / total,
        "robot_translation": left * translation / total,
        "robot_rotation": left * rotation / total,
        **shares,
    }
