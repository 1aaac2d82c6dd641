"""Normal equations with one 6×6 block per view, kept apart by source of noise.

Per source g: U (G, G) for the global parameters, V (n, 6, 6) for the views, W (n, G, 6) between them.
With weights 1/σ_g² they add up; the views are eliminated (Schur complement), so the cost grows linearly
with the number of views and every inverse needed for covariances and traces stays small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.geometry import Array

CORNERS, ROBOT_TRANSLATION, ROBOT_ROTATION, PRIOR = range(4)


@dataclass(frozen=True, eq=False)
class Normal:
    U: Array
    """(4, G, G)"""
    V: Array
    """(4, n, 6, 6)"""
    W: Array
    """(4, n, G, 6)"""
    g: Array
    """(4, G) right-hand side: Jᵀ r of the step that reduces r."""
    h: Array
    """(4, n, 6)"""
    square: Array
    """(4,) sums of squared residuals at the point of linearisation."""
    count: Array
    """(4,) numbers of residuals."""

    @classmethod
    def empty(cls, views: int, size: int) -> Normal:
        return cls(
            np.zeros((4, size, size)),
            np.zeros((4, views, 6, 6)),
            np.zeros((4, views, size, 6)),
            np.zeros((4, size)),
            np.zeros((4, views, 6)),
            np.zeros(4),
            np.zeros(4),
        )

    @property
    def size(self) -> int:
        return int(self.U.shape[1])

    def solve(self, precision: Array) -> Solved:
        """Step and inverses for weights `precision` (4,) = 1/σ². LinAlgError where singular."""
        V, W, U = (weighed(precision, blocks) for blocks in (self.V, self.W, self.U))
        V_inverse = np.asarray(np.linalg.inv(V), dtype=float)
        elimination = W @ V_inverse
        S = U - np.tensordot(elimination, W, axes=([0, 2], [0, 2]))
        h = weighed(precision, self.h)
        right = precision @ self.g - np.einsum("nai,ni->a", elimination, h)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))
        eigenvalues, vectors = np.linalg.eigh((S + S.T) / 2 * np.outer(scale, scale))
        if not eigenvalues[0] > 1e-13:
            raise np.linalg.LinAlgError("the global parameters are not determined")
        basis = vectors * scale[:, None]
        covariance = (basis / eigenvalues) @ basis.T
        step = covariance @ right
        by_view = np.einsum("nij,nj->ni", V_inverse, h) - np.einsum("nai,a->ni", elimination, step)
        log_reduced = float(np.log(eigenvalues).sum() - 2 * np.log(scale).sum())
        return Solved(self, step, by_view, covariance, elimination, V, V_inverse, log_reduced)


def weighed(precision: Array, blocks: Array) -> Array:
    """Sum over the sources (4, …) → (…); np.tensordot's numbers in half its time."""
    return np.asarray((precision @ blocks.reshape(4, -1)).reshape(blocks.shape[1:]))


@dataclass(frozen=True, eq=False)
class Solved:
    normal: Normal
    step: Array
    """(G,)"""
    by_view: Array
    """(n, 6)"""
    covariance: Array
    """(G, G) of the global parameters, views and nuisances marginalised."""
    elimination: Array
    """(n, G, 6) W V⁻¹"""
    V: Array
    """(n, 6, 6)"""
    V_inverse: Array
    log_reduced: float
    """Log determinant of what is left for the global parameters."""

    @property
    def log_determinant(self) -> float:
        """Of the whole normal matrix."""
        return self.log_reduced + float(np.linalg.slogdet(self.V)[1].sum())

    def squares_after_step(self) -> Array:
        """(4,) sums of squares that the linear model predicts at the step's end."""
        n, x, c = self.normal, self.step, self.by_view
        linear = n.g @ x + np.einsum("gni,ni->g", n.h, c)
        quadratic = (n.U @ x) @ x
        quadratic += 2 * ((x @ n.W) * c).sum(axis=(1, 2))
        quadratic += ((n.V @ c[..., None])[..., 0] * c).sum(axis=(1, 2))
        return np.asarray(np.maximum(n.square - 2 * linear + quadratic, 0.0))

    def traces(self) -> Array:
        """(4,) tr(H⁻¹ H_g): degrees of freedom that the parameters take from source g, per unit σ_g²."""
        n = self.normal
        cross = -np.matmul(self.covariance, self.elimination)
        own = self.V_inverse - np.swapaxes(self.elimination, 1, 2) @ cross
        total = np.tensordot(n.U, self.covariance, axes=2)
        total += 2 * n.W.reshape(4, -1) @ cross.reshape(-1)
        total += n.V.reshape(4, -1) @ own.reshape(-1)
        return np.asarray(total)

    def contributions(self, precision: Array) -> Array:
        """(4, 6, 6) parts of X's covariance due to each source; they add up to it."""
        n = self.normal
        P = self.covariance[:, :6]
        Q = -np.einsum("nai,ab->nib", self.elimination, P, optimize=True)
        parts = np.einsum("ax,gab,by->gxy", P, n.U, P, optimize=True)
        mixed = np.einsum("ax,gnai,niy->gxy", P, n.W, Q, optimize=True)
        parts += mixed + np.swapaxes(mixed, 1, 2)
        parts += np.einsum("nix,gnij,njy->gxy", Q, n.V, Q, optimize=True)
        return np.asarray(parts * precision[:, None, None])
