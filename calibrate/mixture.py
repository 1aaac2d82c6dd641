"""Which views are good: a mixture of good and bad ones on the linearised misses, cheap enough to iterate.

At an estimate each view is one miss of six numbers, linear in X, Y (and kinematic errors), with a
covariance known up to the robot's two scales. A bad view has a wider error (`bad_kinds.py`).
Expectation-maximisation (Dempster, Laird, Rubin 1977) weighs each view by its chance to be good. It starts at
the tightest 60 % (least trimmed squares: Rousseeuw 1984), as many bad views together widen the scales until
each of them seems likely. What it finds is believed unless it is far likelier that all are good. The lens is
held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, logsumexp

from calibrate.bad_kinds import LOG_KINDS, bad_kinds, distance2
from calibrate.geometry import Array
from calibrate.likelihood.noise import FLOOR
from calibrate.pairs import Places

_TRIMMED, _FEWEST_TRIMMED = 0.6, 8
_TIGHTER = 0.8
"""Of the trimmed core's scales at the start: bad ones among the tightest widen them."""
_TRIMMING_ROUNDS, _ROUNDS, _SCALE_PASSES = 4, 30, 8
_FIRST_SHARE = 0.2
_BAD_BEFORE, _GOOD_BEFORE = 0.5, 5.0
"""Counts that the share of bad views starts from: it is small unless the views say otherwise."""
_SAME = 1e-2
_FEWEST_WEIGHED = 4.0
"""Fewer do not tell X, Y and two scales."""
_FEWEST_GOOD = 6
"""With fewer left the mixture is not believed."""
_COST_OF_KEEPING = 3.0
"""Bad views kept do this many times the harm of good ones left out, which still count by their worth."""


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

    def normal(self, precision: Array) -> tuple[Array, Array]:
        """Normal matrix (g, g) and right-hand side (g,) for a `precision` (n, 6, 6) of each miss."""
        g = len(self.prior)
        flat = self.by_global.reshape(-1, g)
        normal = flat.T @ (precision @ self.by_global).reshape(-1, g) + np.diag(self.prior)
        return normal, flat.T @ (precision @ self.miss[..., None]).reshape(-1) + self.pull


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
    gained = _evidence(misses, whole, inside) - _evidence(misses, whole, whole)
    return good if gained > -np.log(_COST_OF_KEEPING) else group


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
        distances = distance2(fitted.left, np.linalg.inv(fitted.covariance))
        updated = np.sort(group[np.argsort(distances[group], kind="stable")[:count]])
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
        P = _precision(misses, sigma)
        PJ = P @ J
        normal, right = misses.normal(weights[:, None, None] * P)
        inverse = np.linalg.inv(normal)
        left = misses.miss - J @ (inverse @ right)
        square = (P @ left[..., None])[..., 0] ** 2
        freedom = np.diagonal(P, axis1=1, axis2=2) - ((PJ @ inverse) * PJ).sum(axis=2)
        squares, freedoms = (weights @ part for part in (square, freedom))
        ratio = squares.reshape(2, 3).sum(axis=1) / np.maximum(freedoms.reshape(2, 3).sum(axis=1), 1e-30)
        sigma = np.maximum(sigma * np.sqrt(np.clip(ratio, 0.01, 100.0)), FLOOR[1:3])
    doubt = J @ inverse @ np.swapaxes(J, 1, 2)
    return _Fitted(left, misses.covariance(sigma), doubt, sigma)


def _precision(misses: LinearMisses, sigma: Array) -> Array:
    return np.asarray(np.linalg.inv(misses.covariance(sigma)), dtype=float)


def _evidence(misses: LinearMisses, group: Places, good: Places) -> float:
    """Log probability of the group's misses if just these of it are good, up to a constant.

    Restricted likelihood (Harville 1977) of the good ones at their own scales, the others as predicted by
    them and widened, and the chance of so many bad ones.
    """
    weights = np.zeros(len(misses.miss))
    weights[good] = 1.0
    fitted = _fit(misses, weights, misses.sigma, passes=_SCALE_PASSES)
    P = _precision(misses, fitted.sigma)
    normal, right = misses.normal(weights[:, None, None] * P)
    d2 = float(distance2(misses.miss[good], P[good]).sum() - right @ np.linalg.solve(normal, right))
    log_likelihood = -0.5 * (d2 - np.linalg.slogdet(P[good])[1].sum() + np.linalg.slogdet(normal)[1])
    bad = np.setdiff1d(group, good)
    alone = (fitted.covariance + fitted.doubt)[bad]
    left = fitted.left[bad]
    log_likelihood -= 0.5 * (distance2(left, np.linalg.inv(alone)) + np.linalg.slogdet(alone)[1]).sum()
    log_likelihood += _log_kinds(bad_kinds(left, alone, fitted.sigma).gains)
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
        each = gains[i] + np.log((np.exp(LOG_KINDS) + seen) / (1 + number)) - LOG_KINDS
        together = float(logsumexp(each))
        seen += np.exp(each - together)
        total += together
    return total


def _chance_good(left: Array, covariance: Array, sigma: Array, share: float) -> Array:
    """(n,) given the share of bad views."""
    odds = logsumexp(bad_kinds(left, covariance, sigma).gains, axis=1) + np.log(share / (1 - share))
    return np.asarray(1 / (1 + np.exp(np.clip(odds, -500, 500))))
