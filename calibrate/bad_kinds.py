"""How a view may be bad: the robot's error is wider in some numbers of its pose.

In one of them (a slip of typing), in the translation or the rotation, or in all six. How much is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array

SIZES = np.array([3.0, 8.0, 25.0, 500.0])
"""Robot sigmas that a bad view has besides, equally likely."""
_CHANCES = [0.2, 0.1, 0.1, *[0.1] * 6]
"""Of: all six numbers, translation, rotation, each single number."""
LOG_KINDS = np.log(np.tile(_CHANCES, len(SIZES)) / len(SIZES))
_BLOCKS = (slice(0, 6), slice(0, 3), slice(3, 6))


@dataclass(frozen=True, eq=False)
class BadKinds:
    """Views as bad ones of every kind; densities by the matrix determinant lemma and Woodbury's identity."""

    gains: Array
    """(n, kinds) log density times the kind's chance, relative to a good view's."""
    precision: Array
    """(n, 6, 6) of a good view."""
    singles: Array
    """(sizes, n, 6); with M zero but for this number a kind's precision is P - P M P."""
    blocks: tuple[Array, ...]
    """(sizes, n, r, r), the same for several numbers."""

    def expected_precision(self, chances: Array) -> Array:
        """(n, 6, 6) for the `chances` (n, kinds) of each kind; what is left of 1 is that of being good."""
        P = self.precision
        share = chances.reshape(len(P), len(SIZES), len(_CHANCES))
        taken = np.zeros_like(P)
        for column, (rows, block) in enumerate(zip(_BLOCKS, self.blocks, strict=True)):
            taken[:, rows, rows] += np.einsum("ns,snij->nij", share[..., column], block)
        taken += _diagonals(np.einsum("nsk,snk->nk", share[..., 3:], self.singles))
        return np.asarray(P - P @ taken @ P)

    def scores(self, left: Array) -> Array:
        """(n, kinds, 6) each kind's precision times `left`: what it makes of the miss."""
        P = self.precision
        q = (P @ left[..., None])[..., 0]
        taken = [
            np.einsum("nij,snjk,nk->nsi", P[:, :, rows], block, q[:, rows], optimize=True)[:, :, None]
            for rows, block in zip(_BLOCKS, self.blocks, strict=True)
        ]
        taken.append(np.einsum("nik,snk,nk->nski", P, self.singles, q, optimize=True))
        return np.asarray(q[:, None] - np.concatenate(taken, axis=2).reshape(len(q), -1, 6))


def bad_kinds(left: Array, covariance: Array, sigma: Array) -> BadKinds:
    """`left` (n, 6) misses, `covariance` (n, 6, 6) were they good, `sigma` (2,) the robot's m and rad."""
    P: Array = np.asarray(np.linalg.inv(covariance), dtype=float)
    q = (P @ left[..., None])[..., 0]
    added = (SIZES[:, None] * np.repeat(sigma, 3)) ** 2  # (sizes, 6)
    gains: list[Array] = []
    blocks: list[Array] = []
    for rows in _BLOCKS:
        inner = P[:, rows, rows] + _diagonals(1 / added[:, rows])[:, None]
        blocks.append(np.asarray(np.linalg.inv(inner), dtype=float))
        logarithm = np.linalg.slogdet(inner)[1] + np.log(added[:, rows]).sum(axis=1)[:, None]
        gains.append(0.5 * (distance2(q[:, rows], blocks[-1]) - logarithm)[..., None])
    single = 1 + added[:, None] * np.diagonal(P, axis1=1, axis2=2)  # (sizes, n, 6)
    singles = added[:, None] / single
    gains.append(0.5 * (singles * q**2 - np.log(single)))
    every = np.swapaxes(np.concatenate(gains, axis=2), 0, 1)  # (n, sizes, 9)
    return BadKinds(every.reshape(len(left), len(LOG_KINDS)) + LOG_KINDS, P, singles, tuple(blocks))


def distance2(left: Array, precision: NDArray[np.floating[Any]]) -> Array:
    return np.asarray(((precision @ left[..., None])[..., 0] * left).sum(axis=-1))


def _diagonals(values: Array) -> Array:
    """(m, k) → (m, k, k)"""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))
