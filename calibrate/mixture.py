"""Which views are good: a mixture of good and bad ones on the linearised misses, cheap enough to iterate.

At an estimate each view is one miss of six numbers, linear in X, Y (and kinematic errors), with a
covariance known up to the robot's two scales. A bad view has a wider robot error: in one number of the pose,
in its translation or rotation, or in all six, of unknown size. Expectation-maximisation (Dempster, Laird,
Rubin 1977) weighs each view by its chance to be good. It starts at the tightest 60 % (least trimmed
squares: Rousseeuw 1984), as many bad views together widen the scales until each of them seems likely. What
it finds is believed only where it explains the views better than that all are good. The lens is held.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, logsumexp

from calibrate.geometry import Array
from calibrate.likelihood.noise import FLOOR
from calibrate.pairs import Places

_TRIMMED, _FEWEST_TRIMMED = 0.6, 8
_TIGHTER = 0.8
"""Of the trimmed core's scales at the start: bad ones among the tightest widen them."""
_TRIMMING_ROUNDS, _ROUNDS, _SCALE_PASSES = 4, 30, 8
_SIZES = np.array([3.0, 8.0, 25.0, 500.0])
"""Robot sigmas of a bad view, equally likely."""
_LOG_KINDS = np.log(np.tile([0.2, 0.1, 0.1, *[0.1] * 6], len(_SIZES)) / len(_SIZES))
"""Chances of size and kind: all six numbers, translation, rotation, each single number."""
_FIRST_SHARE = 0.2
_BAD_BEFORE, _GOOD_BEFORE = 0.5, 5.0
"""Counts that the share of bad views starts from: it is small unless the views say otherwise."""
_SAME = 1e-2
_FEWEST_WEIGHED = 4.0
"""Fewer do not tell X, Y and two scales."""
_FEWEST_GOOD = 6
"""With fewer left the mixture is not believed."""


@dataclass(frozen=True, eq=False)
class LinearMisses:
    """All views around one estimate."""

    miss: Array
    """(n, 6) modelled against recorded flange."""
    by_global: Array
    """(n, 6, g) its derivative by X, Y and kinematic errors."""
    by_corners: Array
    """(n, 6, 6) its covariance due to the corners."""
    prior: Array
    """(g,) precision of the global parameters, 0 for X and Y."""
    pull: Array
    """(g,) `prior` times the parameters' distance from it."""
    sigma: Array
    """(2,) robot m, rad."""

    def covariance(self, sigma: Array) -> Array:
        """(n, 6, 6) of the misses, were the robot's scales (2,) these."""
        return np.asarray(self.by_corners + np.diag(np.repeat(sigma**2, 3)))


@dataclass(frozen=True, eq=False)
class _Fitted:
    """By weighed views."""

    left: Array
    """(n, 6) misses that remain."""
    covariance: Array
    """(n, 6, 6)"""
    doubt: Array
    """(n, 6, 6) what the parameters' uncertainty adds."""
    sigma: Array


def find_good_views(misses: LinearMisses, group: Places, usable: NDArray[np.bool_]) -> Places:
    """Those more likely good than bad; the group itself where all of it may well be good.

    group: those that agreed roughly; among them the tightest are sought and the share of bad ones is counted,
    as grossly wrong views say nothing about those that look nearly right.
    """
    whole = group[usable[group]]
    good = _weigh(misses, group, usable)
    inside = np.intersect1d(good, whole)
    if not _FEWEST_GOOD <= len(inside) < len(whole):
        return group
    likelier = _evidence(misses, whole, inside) > _evidence(misses, whole, whole)
    return good if likelier else group


def _weigh(misses: LinearMisses, group: Places, usable: NDArray[np.bool_]) -> Places:
    """Expectation-maximisation from the tightest of the group."""
    weights, fitted = _tightest(misses, group)
    sigma = _TIGHTER * fitted.sigma
    fitted = _Fitted(fitted.left, misses.covariance(sigma), fitted.doubt, sigma)
    share = _FIRST_SHARE
    for _ in range(_ROUNDS):
        before = weights
        weights = _chance_good(fitted.left, fitted.covariance, fitted.sigma, share) * usable
        if weights.sum() < _FEWEST_WEIGHED:
            return np.flatnonzero(weights > 0.5)
        bad = len(group) - weights[group].sum()
        share = (bad + _BAD_BEFORE) / (len(group) + _BAD_BEFORE + _GOOD_BEFORE)
        fitted = _fit(misses, weights, fitted.sigma, passes=2)
        if np.abs(weights - before).max() < _SAME:
            break
    # At last each is judged as by an estimate without it.
    alone = fitted.covariance + (1 - 2 * weights)[:, None, None] * fitted.doubt
    return np.flatnonzero((_chance_good(fitted.left, alone, fitted.sigma, share) > 0.5) & usable)


def _tightest(misses: LinearMisses, group: Places) -> tuple[Array, _Fitted]:
    """Weights 0 or 1, and the fit by them."""
    count = min(len(group), max(int(np.ceil(_TRIMMED * len(group))), _FEWEST_TRIMMED))
    core, weights = group, np.zeros(len(misses.miss))
    weights[core] = 1.0
    fitted = _fit(misses, weights, misses.sigma, passes=3)
    for _ in range(_TRIMMING_ROUNDS):
        distance2 = _distance2(fitted.left, np.linalg.inv(fitted.covariance))
        updated = np.sort(group[np.argsort(distance2[group], kind="stable")[:count]])
        if np.array_equal(updated, core):
            break
        core, weights = updated, np.zeros(len(weights))
        weights[core] = 1.0
        fitted = _fit(misses, weights, fitted.sigma, passes=3)
    return weights, fitted


def _fit(misses: LinearMisses, weights: Array, sigma: Array, passes: int) -> _Fitted:
    """Weighed least squares; scales by passes of the REML fixed point as in `likelihood.noise`."""
    J = misses.by_global
    for _ in range(passes):
        P, PJ, normal, right = _equations(misses, weights, sigma)
        inverse = np.linalg.inv(normal)
        left = misses.miss - J @ (inverse @ right)
        square = (P @ left[..., None])[..., 0] ** 2
        freedom = np.diagonal(P, axis1=1, axis2=2) - ((PJ @ inverse) * PJ).sum(axis=2)
        squares, freedoms = (weights @ part for part in (square, freedom))
        ratio = squares.reshape(2, 3).sum(axis=1) / np.maximum(freedoms.reshape(2, 3).sum(axis=1), 1e-30)
        sigma = np.maximum(sigma * np.sqrt(np.clip(ratio, 0.01, 100.0)), FLOOR[1:3])
    doubt = J @ inverse @ np.swapaxes(J, 1, 2)
    return _Fitted(left, misses.covariance(sigma), doubt, sigma)


def _equations(misses: LinearMisses, weights: Array, sigma: Array) -> tuple[Array, Array, Array, Array]:
    """P (n, 6, 6) precisions, P J (n, 6, g), normal matrix (g, g) and right-hand side (g,)."""
    J, n = misses.by_global, len(weights)
    flat = (J * weights[:, None, None]).reshape(6 * n, -1)
    P = np.asarray(np.linalg.inv(misses.covariance(sigma)), dtype=float)
    PJ = P @ J
    normal = flat.T @ PJ.reshape(6 * n, -1) + np.diag(misses.prior)
    right = flat.T @ (P @ misses.miss[..., None]).reshape(-1) + misses.pull
    return P, PJ, normal, right


def _evidence(misses: LinearMisses, group: Places, good: Places) -> float:
    """Log probability of the group's misses if just these of it are good, up to a constant.

    Restricted likelihood (Harville 1977) of the good ones at their own scales, the others as predicted by
    them and widened, and the chance of so many bad ones.
    """
    weights = np.zeros(len(misses.miss))
    weights[good] = 1.0
    fitted = _fit(misses, weights, misses.sigma, passes=_SCALE_PASSES)
    P, _, normal, right = _equations(misses, weights, fitted.sigma)
    d2 = float(_distance2(misses.miss[good], P[good]).sum() - right @ np.linalg.solve(normal, right))
    log_likelihood = -0.5 * (d2 - np.linalg.slogdet(P[good])[1].sum() + np.linalg.slogdet(normal)[1])
    bad = np.setdiff1d(group, good)
    alone = (fitted.covariance + fitted.doubt)[bad]
    left = fitted.left[bad]
    log_likelihood -= 0.5 * (_distance2(left, np.linalg.inv(alone)) + np.linalg.slogdet(alone)[1]).sum()
    log_likelihood += _log_kinds(_gains(left, alone, fitted.sigma))
    # Half of all recordings have no bad view; in the others any number is as likely as any other.
    chance = betaln(len(bad) + 1, len(good) + 1) if len(bad) else 0.0
    return float(log_likelihood + chance)


def _log_kinds(gains: Array) -> float:
    """Log density of bad views (m, kinds) together, relative to good ones.

    What kind one is makes the same likelier for the next (Pólya: Blackwell, MacQueen 1973). The clearest
    come first.
    """
    total, seen = 0.0, np.zeros(gains.shape[1])
    for number, i in enumerate(np.argsort(-gains.max(axis=1, initial=-np.inf), kind="stable")):
        each = gains[i] + np.log((np.exp(_LOG_KINDS) + seen) / (1 + number)) - _LOG_KINDS
        together = float(logsumexp(each))
        seen += np.exp(each - together)
        total += together
    return total


def _distance2(left: Array, precision: NDArray[np.floating[Any]]) -> Array:
    return np.asarray(((precision @ left[..., None])[..., 0] * left).sum(axis=-1))


def _chance_good(left: Array, covariance: Array, sigma: Array, share: float) -> Array:
    """(n,) given the share of bad views."""
    odds = logsumexp(_gains(left, covariance, sigma), axis=1) + np.log(share / (1 - share))
    return np.asarray(1 / (1 + np.exp(np.clip(odds, -500, 500))))


def _gains(left: Array, covariance: Array, sigma: Array) -> Array:
    """(n, kinds) log density of each view as a bad one of each kind, by its chance, relative to a good one.

    A bad view's covariance has the square of its size added in some of the robot's numbers; densities by the
    matrix determinant lemma and Woodbury's identity.
    """
    P = np.linalg.inv(covariance)
    q = (P @ left[..., None])[..., 0]
    added = (_SIZES[:, None] * np.repeat(sigma, 3)) ** 2  # (sizes, 6)
    single = 1 + added[:, None] * np.diagonal(P, axis1=1, axis2=2)  # (sizes, n, 6)
    gains = [0.5 * (added[:, None] * q**2 / single - np.log(single))]
    for rows in (slice(3, 6), slice(0, 3), slice(0, 6)):
        inner = P[:, rows, rows] + _diagonals(1 / added[:, rows])[:, None]
        logarithm = np.linalg.slogdet(inner)[1] + np.log(added[:, rows]).sum(axis=1)[:, None]
        gains.insert(0, 0.5 * (_distance2(q[:, rows], np.linalg.inv(inner)) - logarithm)[..., None])
    kinds = np.concatenate(gains, axis=2)  # (sizes, n, 9)
    return np.swapaxes(kinds, 0, 1).reshape(len(left), len(_LOG_KINDS)) + _LOG_KINDS


def _diagonals(values: Array) -> Array:
    """(m, k) → (m, k, k)"""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))
