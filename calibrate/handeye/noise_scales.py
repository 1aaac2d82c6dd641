"""Scales of the noise, fitted by restricted maximum likelihood between two solutions of the unknowns.

Each update is a fixed point of the likelihood's derivative: a variance is multiplied by the squares that the
residuals have over those that their covariance predicts, the part that the fit absorbed taken off. A weak
prior stands beside each.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calibrate.handeye.mixture import GAIN, GARBAGE_M, GARBAGE_RAD, SHARE_COUNTS
from recordings.geometry import Array

WIDE = 3.0
_USUAL_ROBOT = np.array([1e-4, np.radians(0.02)])
"""Scale of the half-Cauchy prior of the robot's noise, metres and radians: below it all are alike, above it
their density falls as 1/σ² (A. Gelman, 2006). An inverse gamma prior about it, as is usual, would widen the
regions of accurate arms: their noise is a tenth of it, and the corners hide what the views say of it."""
MODE_COUNT = 4.0
"""Weight, in residuals, of the prior that τ is about λ or larger."""


@dataclass(frozen=True)
class MeasurementNoise:
    """Noise of corners and robot, 1σ per axis."""

    corner_px: float = 0.15
    robot_m: float = 0.0001
    robot_rad: float = 0.00017


@dataclass(frozen=True, eq=False)
class Scales:
    """Scales (1σ) of the noise of robot and corners, and the shares of the noise classes."""

    robot: Array
    """(2,) metres and radians per axis, of a view of the first class."""
    tau_px: float
    lambda_px: float
    sigma_px: float
    shares: Array
    """(K,) prior probability of each class."""
    arm_error_sigma: Array = field(default_factory=lambda: np.zeros(0))
    """(q,) prior 1σ of each systematic error, mm and mrad."""

    @property
    def classes(self) -> Array:
        """Variances (K, 6) of the robot's noise in each class."""
        garbage = np.repeat([GARBAGE_M**2, GARBAGE_RAD**2], 3)
        return np.concatenate([GAIN[:, None] ** 2 * np.repeat(self.robot, 3) ** 2, garbage[None]])


LEAST_ROBOT = 1e-7
"""Least robot noise (m and rad): below it, poses are a computation, and their rounding is no arm's error."""


def update_robot(scales: Scales, chances: Array, z: Array, P: Array) -> Scales:
    """Update the robot's two scales and the shares of the classes.

    chances: (n, K) of the classes; z: (n, K, 6) S_k⁻¹ m; P: (n, K, 6, 6) S_k⁻¹ less what the fit absorbs.
    """
    square, ordinary = scales.robot**2, chances[:, :-1] * GAIN**2
    found = np.einsum("nk,nki->i", ordinary, z[:, :-1] ** 2)
    predicted = np.einsum("nk,nkii->i", ordinary, P[:, :-1].clip(0.0))
    up = found.reshape(2, 3).sum(axis=1) + 1 / square
    down = predicted.reshape(2, 3).sum(axis=1) + 2 / (square + _USUAL_ROBOT**2)
    total = chances.sum(axis=0) + SHARE_COUNTS
    return replace(scales, robot=np.sqrt(square * up / down).clip(LEAST_ROBOT), shares=total / total.sum())


def update_corners(
    scales: Scales, chances: Array, z: Array, P: Array, V: Array, sigma2: float, lambda2: float
) -> Scales:
    """Update τ, and take over σ² and λ² (px²). V: (n, 6, 6) covariance of m by corners of 1 px."""
    tau2 = scales.tau_px**2
    found = np.einsum("nk,nki,nij,nkj->", chances, z, V, z)
    predicted = np.einsum("nk,nkij,nji->", chances, P, V)
    tau2 *= float((found + MODE_COUNT * lambda2 / tau2**2) / (predicted + MODE_COUNT / tau2))
    tau, lambda_, sigma = np.sqrt([max(tau2, lambda2), lambda2, sigma2]).tolist()
    return replace(scales, tau_px=tau, lambda_px=lambda_, sigma_px=sigma)
