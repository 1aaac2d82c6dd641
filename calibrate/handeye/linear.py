"""The posterior linearised at one state, with the board poses eliminated.

A view's board pose C_i is eliminated exactly. What is left of the view is a robot residual m_i with
covariance S = τ² V + D: V from the corners (`corner_modes`), D the robot's own noise (`mixture`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from calibrate.handeye.cell_state import CellState, Layout, Quadratic, flange_derivatives, flange_residuals
from calibrate.handeye.corner_modes import INFORMATION, CornerModes
from calibrate.handeye.mixture import SHARE_COUNTS, class_chances, expected
from calibrate.handeye.noise_scales import WIDE, Scales, update_corners, update_robot
from calibrate.handeye.reprojection import linearise_corners
from calibrate.handeye.uncertainty import Inverse, information_lost, inverse_of
from calibrate.views.view_set import Observations
from recordings.geometry import Array, perturb

ROUNDS = 8
"""Rounds of expectation and maximisation at one linearisation; the next linearisation goes on with them."""
MAX_STEPS = 15
"""Most linearisations of a fit."""
_SETTLED = 1e-3
"""Relative change of every scale by one round below which the rounds end. The scales may then be some percent
from where they would end, and the evidence, which is flat there, some hundredths."""
Fit = Literal["all", "robot", "nothing"]
"""Which noise scales are fitted."""


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """A solution of the linearised posterior."""

    step: Array
    """(G,) in the order of `Layout`."""
    precision: Array
    """(G, G) information, as if the present class probabilities were known."""
    inverse: Inverse
    """Of `precision`."""
    W: Array
    """(n, 6, 6) information of each residual."""
    scales: Scales
    chances: Array
    """(n, K) probability of each noise class, per view."""
    residual: Array
    """(n, 6) m at the step's end."""
    z: Array
    """(n, K, 6) S_k⁻¹ m at the step's end."""
    log_evidence: float
    """Log evidence (Laplace) of the robot's residuals, and of the corners', relative to the best lens
    and shape; up to a constant."""


@dataclass(frozen=True, eq=False)
class Linear:
    """The posterior around one state."""

    U: Array
    """(n, 6, 6) covariance of each board pose by its own corners, for corner noise of 1 px."""
    J_C: Array
    """(n, 6, 6) ∂m/∂C"""
    m: Array
    """(n, 6) robot residual with each board pose at its own corners' optimum."""
    J: Array
    """(n, 6, G) ∂m/∂(shared unknowns)"""
    modes: CornerModes | None = None
    """None where the input holds board poses without corners."""

    @cached_property
    def V(self) -> Array:
        """Covariance (n, 6, 6) of m by corner noise of 1 px."""
        V = self.J_C @ self.U @ np.swapaxes(self.J_C, 1, 2)
        return np.asarray((V + np.swapaxes(V, 1, 2)) / 2)

    @classmethod
    def at(
        cls, observed: Observations, state: CellState, weights: Array, information: float = INFORMATION
    ) -> Linear:
        """Linearise at `state` for corner weights (n, k).

        information: that of a corner over one with normal noise of the same scale.
        """
        at, n = Layout.of(state), len(observed)
        m = flange_residuals(observed, state)
        bare = m + observed.by_arm_errors @ state.arm_errors
        by_X, by_Y, J_C = flange_derivatives(observed.mount, state.X, state.Y, state.C, bare)
        J = np.zeros((n, 6, at.size))
        J[..., at.X], J[..., at.Y] = by_X, by_Y
        J[..., at.arm_errors] = -observed.by_arm_errors
        if not observed.has_pixels:
            return cls(np.zeros((n, 6, 6)), J_C, m, J)
        blocks = linearise_corners(observed, state.camera, state.C, information * weights, True, state.shape)
        U = np.asarray(np.linalg.inv(blocks.LL), dtype=float)
        modes = CornerModes.of(blocks, U, slice(at.lens.start, at.shape.stop))
        J[..., modes.shared] = -J_C @ modes.free.by_shared
        return cls(U, J_C, m + (J_C @ modes.free.to_optimum[..., None])[..., 0], J, modes)

    def first_scales(self, wide: float = WIDE) -> Scales:
        """Take initial noise scales from the medians of the residuals, the robot's times `wide`.

        Above 1, `wide` starts with a wide noise, so that no view begins as an outlier.
        """
        parts = self.m.reshape(-1, 2, 3).swapaxes(0, 1).reshape(2, -1)
        robot = np.maximum(wide * 1.48 * np.median(np.abs(parts), axis=1), 1e-5)
        corner_px = 1.0 if self.modes is None else self.modes.typical_px
        return Scales(robot, corner_px, corner_px, corner_px, SHARE_COUNTS / SHARE_COUNTS.sum())

    def solve(
        self, prior: Quadratic, scales: Scales, fit: Fit = "all", rounds: int = ROUNDS
    ) -> LinearSolution:
        """Find the step and the noise scales to be fitted, by rounds of expectation and maximisation.

        rounds: the most. A round that changes no scale of the noise by more than `_SETTLED` is the last.
        """
        residual, modes = self.m, self.modes
        for _ in range(1 if fit == "nothing" else rounds):
            S, S_inverse = self.noise(scales)
            chances, _ = class_chances(residual, S, S_inverse, scales.shares)
            W = expected(chances, S_inverse)
            WJ = W @ self.J
            N = prior.N + _summed(self.J, WJ)
            right = prior.right - np.einsum("nia,ni->a", WJ, self.m)
            if modes is not None:
                N[modes.shared, modes.shared] += modes.information / scales.lambda_px**2
                right[modes.shared] += modes.right / scales.lambda_px**2
            inverse = Inverse.of(N)
            step = inverse.times(right)
            residual = self.m + self.J @ step
            z = np.einsum("nkij,nj->nki", S_inverse, residual)
            if fit != "nothing":
                P = S_inverse - S_inverse @ self._seen(inverse.root)[:, None] @ S_inverse
                before = scales
                scales = update_robot(scales, chances, z, P)
                if fit == "all" and modes is not None:
                    root = inverse.root[modes.shared]
                    sigma2, lambda2 = modes.variances(before.lambda_px, root @ root.T, step)
                    scales = update_corners(scales, chances, z, P, self.V, sigma2, lambda2)
                if _has_settled(before, scales):
                    break
        _, log_density = class_chances(residual, S, S_inverse, scales.shares)
        # Quadratic in the step, so its gain over the point of linearisation is right·step - ½ step·N·step.
        evidence = float(log_density.sum()) + prior.log + prior.gain(step) - 0.5 * inverse.log_determinant
        if modes is not None:
            evidence -= modes.cost(step) / scales.lambda_px**2
        return LinearSolution(step, N, inverse, W, scales, chances, residual, z, evidence)

    def noise(self, scales: Scales) -> tuple[Array, Array]:
        """Compute the covariances (n, K, 6, 6) of m for each class, and their inverses."""
        S = scales.tau_px**2 * self.V[:, None] + scales.classes[:, :, None] * np.eye(6)
        return S, np.asarray(np.linalg.inv(S), dtype=float)

    def weights(self, chances: Array, scales: Scales) -> Array:
        """Compute the weight (n,) of each view: its information over that of an ordinary view, 0 for garbage.

        Where the corners' noise hides the robot's, ordinary classes hardly differ, and neither do weights.
        """
        S, S_inverse = self.noise(scales)
        return np.asarray(np.einsum("nk,nkij,nji->n", chances, S_inverse, S[:, 0]) / 6)

    def board_step(self, solved: LinearSolution) -> Array:
        """Compute the step (n, 6) of the board poses that belongs to the step of the shared unknowns."""
        pull = np.einsum("nk,nki->ni", solved.chances, solved.z)
        by_robot = np.einsum("nij,nkj,nk->ni", self.U, self.J_C, pull)
        step = -(solved.scales.tau_px**2) * by_robot
        if self.modes is not None:
            step += self.modes.free.board_step(solved.step[self.modes.shared])
        return np.asarray(step)

    def seen_boards(self, C: Array) -> Array:
        """Move the board poses C (n, 4, 4), each to its own corners' optimum."""
        return C if self.modes is None else perturb(C, self.modes.free.to_optimum)

    def covariance(self, solved: LinearSolution) -> Array:
        """Compute the posterior covariance (G, G), with the uncertainty of the views' classes."""
        return inverse_of(solved.precision - self.lost(solved))

    def lost(self, solved: LinearSolution) -> Array:
        """Compute the information (G, G) lost because the views' classes are unknown."""
        return _summed(self.J, information_lost(solved.chances, solved.z, solved.W) @ self.J)

    def predicted(self, scales: Scales, covariance: Array) -> Array:
        """Predict the covariance (n, 6, 6) of m for ordinary views outside the fit of `covariance` (G, G)."""
        noise = scales.tau_px**2 * self.V + np.diag(scales.classes[0])
        return np.asarray(noise + self.J @ covariance @ np.swapaxes(self.J, 1, 2))

    def _seen(self, root: Array) -> Array:
        """Compute the covariance (n, 6, 6) of m by that of the shared unknowns, R Rᵀ with `root` R (G, G)."""
        rows = self.J.reshape(-1, len(root)) @ root  # one product is twice as fast as one for each view
        by_view = rows.reshape(self.J.shape)
        return np.asarray(by_view @ np.swapaxes(by_view, 1, 2))

    def noise_parts(self, solved: LinearSolution, covariance: Array) -> Array:
        """Compute X's variance (3,) by the noise of corners, robot translation and robot rotation.

        Each is the trace of that part of X's covariance after X's own covariance is made the unit matrix.
        """
        gain = covariance[:6] @ np.swapaxes(self.J, 1, 2) @ solved.W
        m, rad = np.diag(solved.scales.classes[0]) * np.repeat(np.eye(2), 3, axis=1)[:, None]
        sources = (solved.scales.tau_px**2 * self.V, m, rad)
        parts = [(gain @ source @ np.swapaxes(gain, 1, 2)).sum(axis=0) for source in sources]
        return np.array([float(np.trace(np.linalg.solve(covariance[:6, :6], part))) for part in parts])


def _has_settled(before: Scales, after: Scales) -> bool:
    """Tell whether a round changed neither noise nor shares of the classes, the corners' noise included."""
    first = np.array([*before.robot, before.tau_px, before.lambda_px, before.sigma_px, *before.shares])
    second = np.array([*after.robot, after.tau_px, after.lambda_px, after.sigma_px, *after.shares])
    return bool((np.abs(second - first) <= _SETTLED * first).all())


def _summed(J: Array, WJ: Array) -> Array:
    """Sum Jᵀ·WJ (a, b) over the views, for J (n, 6, a) and WJ (n, 6, b)."""
    return np.asarray(J.reshape(-1, J.shape[-1]).T @ WJ.reshape(-1, WJ.shape[-1]))
