"""The sum over all pairs as one quadratic form: an evaluation costs the same for 18 pairs and for 5000.

With ζ = [vec(R - R0); b - b0; 1] (13 numbers, vec row by row) every residual of A X = X B is linear in ζ,
so f(X) = ζᵀ gram ζ. It is built recentred at a closed form (R0, b0) near the optimum: there the value is
carried by its last entry alone and nothing cancels, unlike in a plain moment matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from calibrate.handeye.axxb.pairs import Pairs
from recordings.geometry import Array, project_to_rotation, skew

Form = Literal["log", "chordal"]
GENERATORS = skew(np.eye(3))
"""(3, 3, 3) d Exp(δ) / dδ_k at 0."""


@dataclass(frozen=True, eq=False)
class QuadraticObjective:
    """f(R, b) = Σ rotation error² + w Σ translation error² (eq. 16)."""

    gram: Array
    """(13, 13)"""
    R0: Array
    """(3, 3) centre; not necessarily the optimum."""
    b0: Array
    """(3,) metres"""

    def values(self, R: Array, b: Array) -> Array:
        """Evaluate f at candidates R (m, 3, 3), b (m, 3) → (m,)."""
        z = np.empty((len(R), 13))
        np.subtract(R.reshape(-1, 9), self.R0.reshape(9), out=z[:, :9])
        np.subtract(b, self.b0, out=z[:, 9:12])
        z[:, 12] = 1.0
        return np.asarray(np.einsum("mi,mi->m", z @ self.gram, z))

    def value(self, X: Array) -> float:
        """Evaluate f at one X (4, 4)."""
        return float(self.values(X[None, :3, :3], X[None, :3, 3])[0])

    def best_translation(self, R: Array) -> Array:
        """Find the b (m, 3) that minimises f for given R (m, 3, 3); least norm from b0 where not unique."""
        z = np.concatenate([(R - self.R0).reshape(-1, 9), np.ones((len(R), 1))], axis=1)
        return np.asarray(self.b0 - z @ (self._b_inverse @ self.gram[9:12][:, _REST]).T)

    def reduced(self) -> Array:
        """Eliminate the translation (Schur complement): the (10, 10) form in [vec(R - R0); 1]."""
        cross = self.gram[_REST][:, 9:12]
        reduced = self.gram[np.ix_(_REST, _REST)] - cross @ self._b_inverse @ cross.T
        return np.asarray((reduced + reduced.T) / 2)

    def curvature(self, X: Array) -> Array:
        """Compute half the Gauss-Newton Hessian (6, 6) at X, for `geometry.perturb`'s delta."""
        J = np.zeros((13, 6))
        J[9:12, :3] = np.eye(3)
        J[:9, 3:] = (GENERATORS @ X[:3, :3]).reshape(3, 9).T
        return np.asarray(J.T @ self.gram @ J)

    @cached_property
    def _b_inverse(self) -> Array:
        return np.asarray(np.linalg.pinv(self.gram[9:12, 9:12], rcond=1e-10, hermitian=True))


_REST = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12]


def build_objective(
    pairs: Pairs, form: Form = "chordal", weight: float = 1.0, centre: Array | None = None
) -> QuadraticObjective:
    """Collapse pairs into the quadratic form. `weight` is w, rad²/m²; `centre` an X (4, 4) near the optimum,
    where one is known (default: Procrustes on the logarithms).

    log: ‖α - R β‖² with the logarithms of eqs. 12-13. chordal: ½‖R_A R - R R_B‖², which has the same small
    angle limit per pair, is smooth through θ = π and needs no choice of branch.
    """
    R0 = closed_form_rotation(pairs) if centre is None else centre[:3, :3]
    R_A, b_A, b_B = pairs.A[:, :3, :3], pairs.A[:, :3, 3], pairs.B[:, :3, 3]
    D = R_A - np.eye(3)
    b0 = _closed_form_translation(D, b_A - b_B @ R0.T) if centre is None else centre[:3, 3]
    residual_t = (D.reshape(-1, 3) @ b0).reshape(-1, 3) + b_A - b_B @ R0.T
    G = np.zeros((13, 13))
    if form == "log":
        alpha, beta = pairs.alpha, pairs.beta
        residual_r = alpha - beta @ R0.T
        G[:9, :9] = np.kron(np.eye(3), beta.T @ beta)
        G[:9, 12] = -(residual_r.T @ beta).reshape(9)
        G[12, 12] = (residual_r**2).sum()
    else:
        _add_chordal(G, R_A, pairs.B[:, :3, :3], R0)
    G[:9, :9] += weight * np.kron(np.eye(3), b_B.T @ b_B)
    G[:9, 12] -= weight * (residual_t.T @ b_B).reshape(9)
    G[:9, 9:12] = -weight * (D.reshape(-1, 9).T @ b_B).reshape(3, 3, 3).transpose(0, 2, 1).reshape(9, 3)
    flat = D.reshape(-1, 3)
    G[9:12, 9:12] = weight * flat.T @ flat
    G[9:12, 12] = weight * (flat.T @ residual_t.reshape(-1))
    G[12, 12] += weight * (residual_t**2).sum()
    G[9:12, :9] = G[:9, 9:12].T
    G[12, :12] = G[:12, 12]
    return QuadraticObjective(G, R0, b0)


def _add_chordal(G: Array, R_A: Array, R_B: Array, R0: Array) -> None:
    """Add ½‖R_A R - R R_B‖² in the recentred variables: M = R_A ⊗ I - I ⊗ R_Bᵀ on vec R."""
    products = R_A.reshape(-1, 9).T @ R_B.reshape(-1, 9)
    cross = products.reshape(3, 3, 3, 3).transpose(0, 2, 1, 3).reshape(9, 9)
    G[:9, :9] = len(R_A) * np.eye(9) - (cross + cross.T) / 2
    residual = R_A @ R0 - R0 @ R_B
    gradient = np.swapaxes(R_A, 1, 2) @ residual - residual @ np.swapaxes(R_B, 1, 2)
    G[:9, 12] = gradient.sum(axis=0).reshape(9) / 2
    G[12, 12] = (residual**2).sum() / 2


def closed_form_rotation(pairs: Pairs) -> Array:
    """Find the R (3, 3) that best turns β into α: Procrustes on rotation vectors (Park and Martin 1994)."""
    return project_to_rotation(pairs.alpha.T @ pairs.beta)


def _closed_form_translation(D: Array, right: Array) -> Array:
    """Solve D b + right = 0 for b (3,) by least squares; D (n, 3, 3), right (n, 3)."""
    flat = D.reshape(-1, 3)
    return np.asarray(
        -np.linalg.pinv(flat.T @ flat, rcond=1e-10, hermitian=True) @ flat.T @ right.reshape(-1)
    )


_FEWEST_FOR_SANDWICH = 10
"""With fewer views their scores do not span six directions: pairs then count as independent."""


def pair_covariance(objective: QuadraticObjective, pairs: Pairs, X: Array) -> Array:
    """Compute the covariance (6, 6) of the optimum X of the chordal objective over `pairs`.

    Pairs share views, so a sandwich H⁻¹ (Σ_i s_i s_iᵀ) H⁻¹ with one score per view, s_i the sum of the
    gradients of its pairs: the variance of a sum over pairs is that of its projection on views (Hájek 1968).
    """
    H_inverse = np.linalg.pinv(objective.curvature(X), hermitian=True)
    views, first = np.unique(np.concatenate([pairs.first, pairs.second]), return_inverse=True)
    n = len(views)
    if n < _FEWEST_FOR_SANDWICH:
        variance = max(objective.value(X), 0.0) / max(6 * len(pairs) - 6, 1)
        return np.asarray(variance * H_inverse * n / 2)
    scores = np.zeros((n, 6))
    gradients = _gradients(pairs, X)
    np.add.at(scores, first[: len(pairs)], gradients)
    np.add.at(scores, first[len(pairs) :], gradients)
    return np.asarray(H_inverse @ (scores.T @ scores) @ H_inverse * n / (n - 2))


def _gradients(pairs: Pairs, X: Array) -> Array:
    """Compute half the gradient of each pair's term, (n, 6)."""
    R, b = X[:3, :3], X[:3, 3]
    R_A, R_B, b_B = pairs.A[:, :3, :3], pairs.B[:, :3, :3], pairs.B[:, :3, 3] @ R.T
    residual = R_A @ R - R @ R_B
    gamma = (np.swapaxes(R_A, 1, 2) @ residual - residual @ np.swapaxes(R_B, 1, 2)) / 2
    turn = np.einsum("nij,kij->nk", gamma, GENERATORS @ R)
    D = R_A - np.eye(3)
    shift = D @ b + pairs.A[:, :3, 3] - b_B
    return np.concatenate([np.einsum("nji,nj->ni", D, shift), turn - np.cross(b_B, shift)], axis=1)
