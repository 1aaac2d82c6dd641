"""Uncertainty of a fit: the inverse of its information, and what unknown noise classes take off it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recordings.geometry import Array

_ROUNDING = 1e-14
"""Eigenvalue, of a matrix scaled to ones, that rounding alone may leave of one that is zero."""
_WELL_DETERMINED = 1e-11
"""Reciprocal condition from which a Cholesky factor inverts a matrix accurately, ten times as fast."""


@dataclass(frozen=True, eq=False)
class Inverse:
    """The inverse of a symmetric positive matrix N (g, g), kept as a root R: N⁻¹ = R Rᵀ."""

    root: Array
    """(g, g) R"""
    log_determinant: float
    """Of N."""

    @classmethod
    def of(cls, N: Array) -> Inverse:
        """Factorise N, scaled to ones first. LinAlgError where it is not positive.

        A direction that is undetermined up to rounding (two terms of a rational lens, say) gets a huge
        variance, not an infinite one.
        """
        from scipy.linalg import eigh, lapack  # a fifth of the start of a daemon, whose worker alone inverts

        scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
        log_scale = float(np.log(scale).sum())
        scaled = N * scale[:, None] * scale
        factor, failed = lapack.dpotrf(scaled, lower=True)
        if not failed and _is_accurate(factor, scaled):
            inverted = lapack.dtrtri(factor, lower=True)[0]
            log_determinant = 2.0 * (float(np.log(factor.diagonal()).sum()) - log_scale)
            return cls(scale[:, None] * inverted.T, log_determinant)
        # Not divide and conquer: it fails for about one matrix in a thousand.
        values, vectors = eigh((scaled + scaled.T) / 2, driver="ev", check_finite=False)
        if not values[0] > -_ROUNDING:
            raise np.linalg.LinAlgError("some unknowns are left open")
        values = np.maximum(values, _ROUNDING)
        log_determinant = float(np.log(values).sum()) - 2.0 * log_scale
        return cls(vectors * scale[:, None] / np.sqrt(values), log_determinant)

    @property
    def matrix(self) -> Array:
        """(g, g) N⁻¹"""
        return np.asarray(self.root @ self.root.T)

    def times(self, right: Array) -> Array:
        """Compute N⁻¹ (g, g) times `right` (g,)."""
        return np.asarray(self.root @ (right @ self.root))


def _is_accurate(factor: Array, scaled: Array) -> bool:
    """Tell whether a lower Cholesky factor inverts `scaled` accurately."""
    from scipy.linalg import lapack

    norm = np.abs(scaled).sum(axis=0).max()
    return bool(lapack.dpocon(factor, norm, uplo="L")[0] > _WELL_DETERMINED)


def inverse_of(N: Array) -> Array:
    """Invert a symmetric positive matrix, as `Inverse.of` does. LinAlgError where it is not positive."""
    return Inverse.of(N).matrix


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
