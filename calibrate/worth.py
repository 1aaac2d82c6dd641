"""What each number of each recorded pose is worth to X: a bad view is seldom bad in everything.

Every view counts with the precision expected over its chances to be good and to be bad of each kind
(expectation-maximisation, as in `mixture.py`, at the noise scales of the good views). Where one number is
wrong five remain; where nothing tells how bad a view is, little does; a view in doubt counts by half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from calibrate.bad_kinds import LOG_KINDS, SIZES, bad_kinds, distance2
from calibrate.geometry import Array
from calibrate.mixture import LinearMisses
from calibrate.pairs import Places

_ROUNDS = 30
_SAME = 1e-3
_BAD_BEFORE, _GOOD_BEFORE = 0.5, 5.0
"""Counts that the share of bad views starts from, as in the mixture."""
_WIDER = 1 + SIZES**2
_WHOLE = 0.1
"""Chance that robot and corners of a bad view are worse together (it shook)."""
_FIRST_KINDS = np.append((1 - _WHOLE) * np.exp(LOG_KINDS), np.full(len(SIZES), _WHOLE / len(SIZES)))
_WIDEST = 2.0
"""Times a sigma: guessing at the kinds makes X no more uncertain than this."""
_DOUBT = 0.2
"""Chance to be bad below which a view counts fully (else gross errors elsewhere would cost good views), and
chance to be good below which it is bad."""
_NOTHING = 0.02
"""A number that is worth less is not used at all."""


@dataclass(frozen=True, eq=False)
class Worths:
    worth: Array
    """(n, 6) factors 0…1 on the residuals of the numbers."""
    lost: Array
    """(g, g) information on X, Y (and kinematic errors) that is lost as the kinds are only guessed."""
    chance_bad: Array
    """(n,) 0 of those that count fully."""

    @property
    def bad(self) -> Places:
        return np.flatnonzero(self.chance_bad > 1 - _DOUBT)


def number_worths(misses: LinearMisses, good: Places, usable: NDArray[np.bool_]) -> Worths:
    """The search begins at the `good` views."""
    kinds = _FIRST_KINDS
    bad = float(usable.sum() - len(good))
    covariance = misses.covariance(misses.sigma)
    precision = np.asarray(np.linalg.inv(covariance), dtype=float)
    precision[np.setdiff1d(np.arange(len(usable)), good)] = 0.0
    chances = np.zeros((len(usable), len(kinds)))
    for _ in range(_ROUNDS):
        normal, right = misses.normal(precision)
        left = misses.miss - misses.by_global @ np.linalg.solve(normal, right)
        odds = (bad + _BAD_BEFORE) / (usable.sum() - bad + _GOOD_BEFORE)
        before = chances
        chances, precision = _weigh(left, covariance, misses.sigma, odds * kinds)
        chances, precision = chances * usable[:, None], precision * usable[:, None, None]
        # What kind the bad ones are makes the same likelier for the others.
        bad = float(chances.sum())
        kinds = (_FIRST_KINDS + chances.sum(axis=0)) / (1 + bad)
        if np.abs(chances - before).max() < _SAME:
            break
    worth = np.zeros((len(usable), 6))
    robot = np.linalg.inv(precision[usable]) - misses.by_corners[usable]
    variance = np.repeat(misses.sigma**2, 3)
    worth[usable] = np.sqrt(variance / np.maximum(np.diagonal(robot, axis1=1, axis2=2), variance))
    J = misses.by_global
    spread = _spread(left, covariance, misses.sigma, chances)
    lost = np.einsum("nia,nij,njb->ab", J[usable], spread[usable], J[usable], optimize=True)
    return Worths(np.where(worth < _NOTHING, 0.0, worth), np.asarray(lost), chances.sum(axis=1))


def _weigh(left: Array, covariance: Array, sigma: Array, odds: Array) -> tuple[Array, Array]:
    """Chance of each kind (n, kinds), expected precision (n, 6, 6); `odds` of each kind against good."""
    found = bad_kinds(left, covariance, sigma)
    d2 = distance2(left, found.precision)[:, None]
    whole = 0.5 * (1 - 1 / _WIDER) * d2 - 3 * np.log(_WIDER)
    each = np.concatenate([found.gains - LOG_KINDS, whole], axis=1) + np.log(odds)
    chances = np.exp(each - np.logaddexp(0.0, logsumexp(each, axis=1))[:, None])
    chances[chances.sum(axis=1) < _DOUBT] = 0.0
    of_robot, of_whole = np.split(chances, [len(LOG_KINDS)], axis=1)
    taken = (of_whole @ (1 - 1 / _WIDER))[:, None, None] * found.precision
    return chances, found.expected_precision(of_robot) - taken


def _spread(left: Array, covariance: Array, sigma: Array, chances: Array) -> Array:
    """(n, 6, 6) covariance over the kinds of precision times miss."""
    found = bad_kinds(left, covariance, sigma)
    good = (found.precision @ left[..., None])[..., 0][:, None]
    scores = np.concatenate([good, found.scores(left), good / _WIDER[:, None]], axis=1)
    every = np.concatenate([1 - chances.sum(axis=1, keepdims=True), chances], axis=1)
    off = scores - np.einsum("nk,nki->ni", every, scores)[:, None]
    return np.asarray(np.einsum("nk,nki,nkj->nij", every, off, off, optimize=True))


def widen(covariance: Array, lost: Array) -> Array:
    """Covariance (g, g) with `lost` information taken off, to at most _WIDEST times a sigma (Louis 1982)."""
    root = np.linalg.cholesky(covariance)
    share, axes = np.linalg.eigh(root.T @ lost @ root)
    wide = (root @ axes) / np.sqrt(1 - np.clip(share, 0.0, 1 - _WIDEST**-2))
    return np.asarray(wide @ wide.T)
