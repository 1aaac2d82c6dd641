"""Noise of the robot as a mixture of classes: three scales of the ordinary noise, and one of garbage.

A view belongs to each class with a probability: the expectation step of EM (Dempster, Laird, Rubin 1977).
"""

from __future__ import annotations

import numpy as np

from recordings.geometry import Array

GAIN = np.array([1.0, 3.0, 10.0])
"""Robot noise of the first three classes, as multiples of the ordinary one."""
GARBAGE_M, GARBAGE_RAD = 0.3, 1.0
"""1σ of the last class, metres and radians: so wide that such a view tells nothing."""
SHARE_COUNTS = np.array([5.0, 0.5 / 3, 0.5 / 3, 0.5 / 3])
"""Dirichlet prior of the classes' shares, in counts of views."""


def class_chances(residual: Array, S: Array, S_inverse: Array, shares: Array) -> tuple[Array, Array]:
    """Compute the probabilities (n, K) of the classes and the log density (n,) of residuals (n, 6).

    S and S_inverse: (n, K, 6, 6) covariance of a residual in each class; shares: (K,) prior probabilities.
    """
    square = np.einsum("ni,nkij,nj->nk", residual, S_inverse, residual)
    log = np.log(shares) - 0.5 * (square + np.linalg.slogdet(S)[1] + 6 * np.log(2 * np.pi))
    top = log.max(axis=1, keepdims=True)
    density = np.exp(log - top)
    total = density.sum(axis=1, keepdims=True)
    return density / total, (top + np.log(total))[:, 0]


def expected(chances: Array, S_inverse: Array) -> Array:
    """Average inverse covariances (n, K, 6, 6) over the classes → (n, 6, 6)."""
    return np.asarray(np.einsum("nk,nkij->nij", chances, S_inverse))
