"""What the corners tell of lens and board shape, and the noise that they have in these modes.

Corner errors are smooth over a board, so they have three variances: τ² on the six modes that move the board's
pose, λ² on those of lens and board shape, σ² on the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calibrate.handeye.noise_scales import MODE_COUNT
from calibrate.handeye.reprojection import CornerBlocks, Eliminated
from recordings.geometry import Array

STUDENT = 8.0
"""Degrees of freedom of Student's t of a corner: a wrong detection loses its weight."""
INFORMATION = (STUDENT + 2) / (STUDENT + 4)
"""Information of a corner with that distribution over that of a normal one of the same scale."""


@dataclass(frozen=True, eq=False)
class CornerModes:
    """Information of the corners about lens and board shape, with each view's board pose eliminated."""

    free: Eliminated
    """Normal equations without the board poses."""
    whole: Array
    """(n, g, g) information if the board poses were known: the scale by which columns are compared."""
    left: Array
    """(n,) weighted squares (px²) at each board pose's optimum."""
    rows: Array
    """(n,) twice the weighted number of corners."""
    shared: slice
    """Positions of lens and shape among the shared unknowns."""

    @classmethod
    def of(cls, blocks: CornerBlocks, U: Array, shared: slice) -> CornerModes:
        """Eliminate the board poses; U: (n, 6, 6) LL⁻¹."""
        free = blocks.without_boards(U)
        left = np.maximum(blocks.rr - np.einsum("ni,ni->n", blocks.Lr, free.to_optimum), 0.0)
        return cls(free, blocks.GG, left / INFORMATION, blocks.rows / INFORMATION, shared)

    @cached_property
    def information(self) -> Array:
        """(g, g) sum over the views."""
        return np.asarray(self.free.information.sum(axis=0))

    @cached_property
    def right(self) -> Array:
        """(g,) sum over the views."""
        return np.asarray(self.free.right.sum(axis=0))

    def cost(self, step: Array) -> float:
        """Compute half the squares (px²) after a step (G,), above those of the best lens and shape."""
        right = self.right - self.information @ step[self.shared]
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->i", self.whole), 1e-300))
        scaled = self.information * np.outer(scale, scale)
        to_best = np.linalg.lstsq(scaled, scale * right, rcond=1e-9)[0]
        return 0.5 * float(right @ (scale * to_best))

    @cached_property
    def _whitening(self) -> tuple[Array, float]:
        """Compute W (n, g, g) with |W·r|² = rᵀ·information⁻¹·r (pseudo-inverse), and the summed rank."""
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->ni", self.whole), 1e-300))
        values, vectors = np.linalg.eigh(self.free.information * scale[:, :, None] * scale[:, None, :])
        kept = values > 1e-6
        root = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0) / np.sqrt(INFORMATION)
        return root[:, :, None] * np.swapaxes(vectors, 1, 2) * scale[:, None, :], float(kept.sum())

    def _own_decrease(self, right: Array) -> float:
        """Compute the decrease of squares (px²) if each view had its own lens and shape; `right`: (n, g)."""
        return float(((self._whitening[0] @ right[..., None]) ** 2).sum())

    @cached_property
    def _rest(self) -> tuple[float, float]:
        """Squares (px²) that no board pose, lens or shape explains, and their number: 0 of a single tag."""
        rest = float(self.left.sum()) - self._own_decrease(self.free.right)
        freedom = float(self.rows.sum()) - 6 * len(self.rows) - self._whitening[1]
        return max(rest, 0.0), max(freedom, 0.0)

    def variances(self, lambda_px: float, covariance: Array, step: Array) -> tuple[float, float]:
        """Estimate σ² and λ² (px²) after a step (G,) with this covariance (g, g) of lens and shape.

        λ² are the squares that each view alone could still win by a lens and shape of its own, over the
        number of these modes less those that the common lens and shape used up. σ has a prior about λ, as λ
        about σ: views of a single tag tell no more of σ.
        """
        rest, freedom = self._rest
        sigma2 = max((rest + MODE_COUNT * lambda_px**2) / (freedom + MODE_COUNT), 1e-8)
        after = self.free.right - self.free.information @ step[self.shared]
        used = float(np.einsum("ij,ji", covariance, self.information)) / lambda_px**2
        rank = self._whitening[1]
        lambda2 = (self._own_decrease(after) + MODE_COUNT * sigma2) / max(rank - used + MODE_COUNT, 1.0)
        return sigma2, max(lambda2, sigma2)

    @property
    def typical_px(self) -> float:
        """Noise of a corner per axis, median over the views."""
        return max(float(np.sqrt(np.median(self.left / np.maximum(self.rows - 6, 1.0)))), 1e-3)
