"""Uncertainty of a fit: the inverse of its information, and what unknown noise classes take off it."""

from __future__ import annotations

import numpy as np

from recordings.geometry import Array

_ROUNDING = 1e-14
"""Eigenvalue, of a matrix scaled to ones, that rounding alone may leave of one that is zero."""
_WELL_DETERMINED = 1e-11
"""Reciprocal condition from which a Cholesky factor inverts a matrix accurately, ten times as fast."""


def inverse_of(N: Array) -> Array:
    """Invert a symmetric positive matrix, scaled to ones first. LinAlgError where it is not.

    A direction that is undetermined up to rounding (two terms of a rational lens, say) gets a huge variance,
    not an infinite one.
    """
    from scipy.linalg import eigh, lapack  # a fifth of the start of a daemon, whose worker alone inverts

    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    scaled = (N + N.T) / 2 * np.outer(scale, scale)
    factor, failed = lapack.dpotrf(scaled)
    if not failed and lapack.dpocon(factor, np.abs(scaled).sum(axis=0).max())[0] > _WELL_DETERMINED:
        half = lapack.dpotri(factor)[0]  # its lower part is zero
        np.fill_diagonal(half, half.diagonal() / 2)
        return np.asarray((half + half.T) * np.outer(scale, scale))
    # Not divide and conquer: it fails for about one matrix in a thousand.
    values, vectors = eigh(scaled, driver="ev", check_finite=False)
    if not values[0] > -_ROUNDING:
        raise np.linalg.LinAlgError("some unknowns are left open")
    root = vectors * scale[:, None]
    return np.asarray((root / np.maximum(values, _ROUNDING)) @ root.T)


def information_lost(chances: Array, z: Array, W: Array) -> Array:
    """Compute the information (n, 6, 6) about a view's residual that its unknown class costs.

    z: (n, K, 6) S_k⁻¹ residual; W: (n, 6, 6) `expected` information. A view cannot lose more than it gives.
    T. Louis (1982).
    """
    mean = np.einsum("nk,nki->ni", chances, z)
    spread = np.einsum("nk,nki,nkj->nij", chances, z, z) - mean[:, :, None] * mean[:, None, :]
    root = np.linalg.cholesky(W)
    inner = np.linalg.solve(root, np.swapaxes(np.linalg.solve(root, spread), 1, 2))
    values, vectors = np.linalg.eigh((inner + np.swapaxes(inner, 1, 2)) / 2)
    inner = (vectors * np.clip(values, 0.0, 1.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    return np.asarray(root @ inner @ np.swapaxes(root, 1, 2))
