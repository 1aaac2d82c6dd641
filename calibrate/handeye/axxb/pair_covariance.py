"""How uncertain an X that minimises the pair objective is, although pairs share views.

A sandwich H⁻¹ (Σ_i s_i s_iᵀ) H⁻¹ with one score per view, s_i the sum of the gradients of its pairs: the
variance of a sum over pairs is that of its projection on views (Hájek 1968).
"""

from __future__ import annotations

import numpy as np

from calibrate.geometry import Array, skew
from calibrate.handeye.axxb.objective import QuadraticObjective
from calibrate.handeye.axxb.pairs import Pairs

_FEWEST_VIEWS = 10
"""With fewer the scores do not span six directions: pairs then count as independent, variance times n/2."""


def pair_covariance(objective: QuadraticObjective, pairs: Pairs, X: Array) -> Array:
    """(6, 6) of `geometry.perturb`'s delta at the optimum X of the chordal objective over `pairs`."""
    H_inverse = np.linalg.pinv(objective.curvature(X), hermitian=True)
    views, first = np.unique(np.concatenate([pairs.first, pairs.second]), return_inverse=True)
    n = len(views)
    if n < _FEWEST_VIEWS:
        variance = max(objective.value(X), 0.0) / max(6 * len(pairs) - 6, 1)
        return np.asarray(variance * H_inverse * n / 2)
    scores = np.zeros((n, 6))
    gradients = _gradients(pairs, X)
    np.add.at(scores, first[: len(pairs)], gradients)
    np.add.at(scores, first[len(pairs) :], gradients)
    return np.asarray(H_inverse @ (scores.T @ scores) @ H_inverse * n / (n - 2))


def _gradients(pairs: Pairs, X: Array) -> Array:
    """Half the gradient of each pair's term, (n, 6)."""
    R, b = X[:3, :3], X[:3, 3]
    R_A, R_B, b_B = pairs.A[:, :3, :3], pairs.B[:, :3, :3], pairs.B[:, :3, 3] @ R.T
    residual = R_A @ R - R @ R_B
    gamma = (np.swapaxes(R_A, 1, 2) @ residual - residual @ np.swapaxes(R_B, 1, 2)) / 2
    turn = np.einsum("nij,kij->nk", gamma, skew(np.eye(3)) @ R)
    D = R_A - np.eye(3)
    shift = D @ b + pairs.A[:, :3, 3] - b_B
    return np.concatenate([np.einsum("nji,nj->ni", D, shift), turn - np.cross(b_B, shift)], axis=1)
