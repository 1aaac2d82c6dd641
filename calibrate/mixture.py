"""Which views are good: a mixture of good and bad ones on the linearised misses, cheap enough to iterate.

At an estimate each view is one miss of six numbers, linear in X, Y (and kinematic errors), with a
covariance known up to the robot's two scales. A bad view has a wider robot error: in one number of the pose,
in its translation or rotation, or in all six, of unknown size. Expectation-maximisation (Dempster, Laird,
Rubin 1977) weighs each view by its chance to be good. It starts at the tightest 60 % (least trimmed
squares: Rousseeuw 1984), as many bad views together widen the scales until each of them seems likely. The
lens is held.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array
from calibrate.likelihood.noise import FLOOR
from calibrate.pairs import Places

_TRIMMED, _FEWEST_TRIMMED = 0.6, 8
_TIGHTER = 0.8
"""Of the trimmed core's scales at the start: bad ones among the tightest widen them."""
_TRIMMING_ROUNDS, _ROUNDS = 4, 30
_SIZES = np.array([3.0, 8.0, 25.0, 500.0])
"""Robot sigmas of a bad view, equally likely."""
_CHANCES = np.log([0.2, 0.1, 0.1, *[0.1] * 6])
"""All six numbers, translation, rotation, each single number."""
_FIRST_SHARE = 0.2
_BAD_BEFORE, _GOOD_BEFORE = 0.5, 5.0
"""Counts that the share of bad views starts from: it is small unless the views say otherwise."""
_SAME = 1e-2
_FEWEST_WEIGHED = 4.0
"""Fewer do not tell X, Y and two scales."""


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
    """Those more likely good than bad.

    group: those that agreed roughly; among them the tightest are sought and the share of bad ones is counted,
    as grossly wrong views say nothing about those that look nearly right.
    """
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
    J, n = misses.by_global, len(weights)
    flat = (J * weights[:, None, None]).reshape(6 * n, -1)
    for _ in range(passes):
        P = np.linalg.inv(misses.covariance(sigma))
        PJ = P @ J
        inverse = np.linalg.inv(flat.T @ PJ.reshape(6 * n, -1) + np.diag(misses.prior))
        right = flat.T @ (P @ misses.miss[..., None]).reshape(-1) + misses.pull
        left = misses.miss - J @ (inverse @ right)
        square = (P @ left[..., None])[..., 0] ** 2
        freedom = np.diagonal(P, axis1=1, axis2=2) - ((PJ @ inverse) * PJ).sum(axis=2)
        squares, freedoms = (weights @ part for part in (square, freedom))
        ratio = squares.reshape(2, 3).sum(axis=1) / np.maximum(freedoms.reshape(2, 3).sum(axis=1), 1e-30)
        sigma = np.maximum(sigma * np.sqrt(np.clip(ratio, 0.01, 100.0)), FLOOR[1:3])
    doubt = J @ inverse @ np.swapaxes(J, 1, 2)
    return _Fitted(left, misses.covariance(sigma), doubt, sigma)


def _distance2(left: Array, precision: NDArray[np.floating[Any]]) -> Array:
    return np.asarray(((precision @ left[..., None])[..., 0] * left).sum(axis=-1))


def _chance_good(left: Array, covariance: Array, sigma: Array, share: float) -> Array:
    """(n,) given the share of bad views.

    A bad view's covariance has the square of its size added in some of the robot's numbers; log densities
    are taken relative to the good one's, by the matrix determinant lemma and Woodbury's identity.
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
    bad = np.concatenate(gains, axis=2) + _CHANCES
    largest = bad.max(axis=(0, 2))
    total = largest + np.log(np.exp(bad - largest[:, None]).sum(axis=(0, 2)) / len(_SIZES))
    odds = total + np.log(share / (1 - share))
    return np.asarray(1 / (1 + np.exp(np.clip(odds, -500, 500))))


def _diagonals(values: Array) -> Array:
    """(m, k) → (m, k, k)"""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))
