"""The posterior linearised at one state: board poses eliminated, views weighed, noise scales fitted.

A view's board pose C_i is eliminated exactly. What is left of the view is a robot residual m_i with
covariance S = τ² B + D: B from the corners, D the robot's own noise, a mixture of three scales and one class
of garbage. Corner errors are smooth over a board, so they have three variances: τ² on the six modes that move
the board's pose, λ² on those of lens and board shape, σ² on the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy import linalg

from calibrate.geometry import Array, perturb
from calibrate.handeye.cell_state import CellState, Layout, Quadratic, flange_derivatives, flange_residuals
from calibrate.handeye.corners import CornerBlocks, linearise_corners
from calibrate.views import Observations

ROUNDS = 8
GAIN = np.array([1.0, 3.0, 10.0])
"""Robot noise of the first three classes of views, as multiples of the ordinary one."""
GARBAGE_M, GARBAGE_RAD = 0.3, 1.0
"""1σ of the last class, metres and radians: so wide that such a view tells nothing."""
_COUNTS = np.array([5.0, 0.5 / 3, 0.5 / 3, 0.5 / 3])
"""Dirichlet prior of the classes' shares, in counts of views."""
Fit = Literal["all", "robot", "nothing"]
"""Which noise scales are fitted."""
STUDENT = 8.0
"""Degrees of freedom of Student's t of a corner: a wrong detection loses its weight."""
_INFORMATION = (STUDENT + 2) / (STUDENT + 4)
"""Information of a corner with that distribution over that of a normal one of the same scale."""
ROBOT_PRIOR_COUNT = 1.0
_ROBOT_PRIOR_M, _ROBOT_PRIOR_RAD = 1e-4, float(np.radians(0.02))
WIDE = 3.0
_ROUNDING = 1e-14
_MODE_COUNT = 4.0
"""Weight, in residuals, of the prior that τ is about λ or larger."""


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
    table: Array = field(default_factory=lambda: np.zeros(0))
    """(q,) prior 1σ of each systematic error, mm and mrad."""

    @property
    def classes(self) -> Array:
        """Variances (K, 6) of the robot's noise in each class."""
        robot = np.repeat(self.robot, 3) ** 2
        garbage = np.repeat([GARBAGE_M**2, GARBAGE_RAD**2], 3)
        return np.concatenate([GAIN[:, None] ** 2 * robot, garbage[None]])


def first_scales(linear: Linear, wide: float = WIDE) -> Scales:
    """Take initial noise scales from the medians of the residuals, the robot's times `wide`.

    Above 1, `wide` starts with a wide noise, so that no view begins as an outlier.
    """
    robot = [wide * 1.48 * float(np.median(np.abs(part))) for part in (linear.m[:, :3], linear.m[:, 3:])]
    pixel = 1.0 if linear.modes is None else linear.modes.typical_px
    robot_m, robot_rad = (max(value, 1e-5) for value in robot)
    return Scales(np.array([robot_m, robot_rad]), pixel, pixel, pixel, _COUNTS / _COUNTS.sum())


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """A solution of the linearised posterior."""

    step: Array
    """(G,) in the order of `Layout`."""
    precision: Array
    """(G, G) information at the present class probabilities, which it takes as certain."""
    scales: Scales
    chances: Array
    """(n, K) probability of each noise class, per view."""
    residual: Array
    """(n, 6) m at the step's end."""
    z: Array
    """(n, K, 6) S_k⁻¹ m at the step's end."""
    log_evidence: float
    """Log evidence of the robot residuals, up to a constant of the linearisation (Laplace)."""


@dataclass(frozen=True, eq=False)
class CornerModes:
    """Information of the corners about lens and board shape, with each view's board pose eliminated."""

    to_optimum: Array
    """(n, 6) step of each board pose to its own corners' optimum."""
    by_shared: Array
    """(n, 6, g) negative derivative of that optimum by lens and shape."""
    information: Array
    """(n, g, g)"""
    right: Array
    """(n, g)"""
    whole: Array
    """(n, g, g) information if the board poses were known: the scale by which columns are compared."""
    left: Array
    """(n,) weighted squares (px²) at each board pose's optimum."""
    rows: Array
    """(n,) twice the weighted number of corners."""
    shared: slice
    """Positions of lens and shape among the shared unknowns."""

    @classmethod
    def of(cls, blocks: CornerBlocks, H: Array, shared: slice) -> CornerModes:
        c = np.einsum("nij,nj->ni", H, blocks.Lr)
        HLG = H @ blocks.LG
        LG_t = np.swapaxes(blocks.LG, 1, 2)
        return cls(
            c,
            HLG,
            blocks.GG - LG_t @ HLG,
            blocks.Gr - (LG_t @ c[..., None])[..., 0],
            blocks.GG,
            np.maximum(blocks.rr - np.einsum("ni,ni->n", blocks.Lr, c), 0.0) / _INFORMATION,
            blocks.rows / _INFORMATION,
            shared,
        )

    def gain(self, step: Array) -> float:
        """Compute half the decrease of the sum of squares (px²) by a step (G,)."""
        x = step[self.shared]
        return float(self.right.sum(axis=0) @ x - 0.5 * x @ self.information.sum(axis=0) @ x)

    @cached_property
    def _whitening(self) -> tuple[Array, float]:
        """Compute W (n, g, g) with |W·r|² = rᵀ·information⁻¹·r (pseudo-inverse), and the summed rank."""
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->ni", self.whole), 1e-300))
        values, vectors = np.linalg.eigh(self.information * scale[:, :, None] * scale[:, None, :])
        kept = values > 1e-6
        root = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0) / np.sqrt(_INFORMATION)
        return root[:, :, None] * np.swapaxes(vectors, 1, 2) * scale[:, None, :], float(kept.sum())

    def _inside(self, right: Array) -> float:
        """Compute the decrease of squares (px²) if each view had its own lens and shape; `right`: (n, g)."""
        return float(((self._whitening[0] @ right[..., None]) ** 2).sum())

    @cached_property
    def _plain(self) -> float:
        """Estimate σ², px²: corner noise that no board pose, lens or shape explains."""
        rest = max(float(self.left.sum()) - self._inside(self.right), 0.0)
        free = float(self.rows.sum()) - 6 * len(self.rows) - self._whitening[1]
        return max(rest / max(free, 1.0), 1e-8)

    def variances(self, lambda_px: float, covariance: Array, step: Array) -> tuple[float, float]:
        """Estimate σ² and λ² (px², see the module's text) after a step (G,) with this covariance (G, G)."""
        after = self.right - self.information @ step[self.shared]
        part = covariance[self.shared, self.shared]
        used = float(np.einsum("ij,ji", part, self.information.sum(axis=0))) / lambda_px**2
        sigma2, rank = self._plain, self._whitening[1]
        lambda2 = (self._inside(after) + _MODE_COUNT * sigma2) / max(rank - used + _MODE_COUNT, 1.0)
        return sigma2, max(lambda2, sigma2)

    @property
    def typical_px(self) -> float:
        """Noise of a corner per axis, median over the views."""
        return max(float(np.sqrt(np.median(self.left / np.maximum(self.rows - 6, 1.0)))), 1e-3)


@dataclass(frozen=True, eq=False)
class Linear:
    """The posterior around one state."""

    H: Array
    """(n, 6, 6) covariance of each board pose by its own corners, for corner noise of 1 px."""
    A: Array
    """(n, 6, 6) ∂m/∂C"""
    m: Array
    """(n, 6) robot residual with each board pose at its own corners' optimum."""
    J: Array
    """(n, 6, G) ∂m/∂(shared unknowns)"""
    modes: CornerModes | None = None
    """None where the input holds board poses without corners."""

    @cached_property
    def B(self) -> Array:
        """Covariance (n, 6, 6) of m by corner noise of 1 px."""
        B = self.A @ self.H @ np.swapaxes(self.A, 1, 2)
        return np.asarray((B + np.swapaxes(B, 1, 2)) / 2)

    @classmethod
    def at(
        cls, observed: Observations, state: CellState, weights: Array, information: float = _INFORMATION
    ) -> Linear:
        """Linearise at `state` for corner weights (n, k).

        information: that of a corner over one with normal noise of the same scale.
        """
        at, n = Layout.of(state), len(observed)
        m = flange_residuals(observed, state)
        bare = m if observed.table is None or not len(state.table) else m + observed.table @ state.table
        by_X, by_Y, A = flange_derivatives(observed.mount, state.X, state.Y, state.C, bare)
        J = np.zeros((n, 6, at.size))
        J[..., at.X], J[..., at.Y] = by_X, by_Y
        if observed.table is not None and len(state.table):
            J[..., at.table] = -observed.table
        if not observed.has_pixels:
            return cls(np.zeros((n, 6, 6)), A, m, J)
        blocks = linearise_corners(observed, state.camera, state.C, information * weights, True, state.shape)
        H = np.asarray(np.linalg.inv(blocks.LL), dtype=float)
        modes = CornerModes.of(blocks, H, slice(at.lens.start, at.shape.stop))
        J[..., modes.shared] = -A @ modes.by_shared
        return cls(H, A, m + (A @ modes.to_optimum[..., None])[..., 0], J, modes)

    def solve(
        self, prior: Quadratic, scales: Scales, fit: Fit = "all", rounds: int = ROUNDS
    ) -> LinearSolution:
        """Find the step and the noise scales to be fitted, by rounds of expectation and maximisation."""
        residual, modes = self.m, self.modes
        for _ in range(1 if fit == "nothing" else rounds):
            S, S_inverse = self._noise(scales)
            chances, _ = _chances(residual, S, S_inverse, scales.shares)
            WJ = np.einsum("nk,nkij->nij", chances, S_inverse) @ self.J
            N = prior.N + _summed(self.J, WJ)
            right = prior.right - np.einsum("nia,ni->a", WJ, self.m)
            if modes is not None:
                N[modes.shared, modes.shared] += modes.information.sum(axis=0) / scales.lambda_px**2
                right[modes.shared] += modes.right.sum(axis=0) / scales.lambda_px**2
            covariance = inverse_of(N)
            step = covariance @ right
            residual = self.m + self.J @ step
            if fit != "nothing":
                scales = self._scales(scales, fit, chances, S_inverse, residual, covariance, step)
        z = np.einsum("nkij,nj->nki", S_inverse, residual)
        _, log_density = _chances(residual, S, S_inverse, scales.shares)
        # Quadratic in the step, so its gain over the point of linearisation is right·step - ½ step·N·step.
        evidence = (
            float(log_density.sum()) + prior.log + prior.gain(step) - 0.5 * float(np.linalg.slogdet(N)[1])
        )
        if modes is not None:
            evidence += modes.gain(step) / scales.lambda_px**2
        return LinearSolution(step, N, scales, chances, residual, z, evidence)

    def _noise(self, scales: Scales) -> tuple[Array, Array]:
        """Compute the covariances (n, K, 6, 6) of m for each class, and their inverses."""
        S = scales.tau_px**2 * self.B[:, None] + scales.classes[:, :, None] * np.eye(6)
        return S, np.asarray(np.linalg.inv(S), dtype=float)

    def _scales(
        self,
        scales: Scales,
        fit: Fit,
        chances: Array,
        S_inverse: Array,
        residual: Array,
        covariance: Array,
        step: Array,
    ) -> Scales:
        z = np.einsum("nkij,nj->nki", S_inverse, residual)
        leverage = self.J @ covariance @ np.swapaxes(self.J, 1, 2)
        P = S_inverse - S_inverse @ leverage[:, None] @ S_inverse
        square = scales.robot**2
        gained = np.einsum("nk,k,nki->i", chances[:, :3], GAIN**2, z[:, :3] ** 2)
        spent = np.einsum("nk,k,nki->i", chances[:, :3], GAIN**2, np.einsum("nkii->nki", P[:, :3]).clip(0.0))
        floor = np.array([_ROBOT_PRIOR_M, _ROBOT_PRIOR_RAD]) ** 2
        count = ROBOT_PRIOR_COUNT
        up = gained.reshape(2, 3).sum(axis=1) + count * floor / square**2
        down = spent.reshape(2, 3).sum(axis=1) + count / square
        square = square * up / np.maximum(down, 1e-300)
        total = chances.sum(axis=0) + _COUNTS
        updated = replace(scales, robot=np.sqrt(square), shares=total / total.sum())
        if fit == "robot" or self.modes is None:
            return updated
        sigma2, lambda2 = self.modes.variances(scales.lambda_px, covariance, step)
        tau2 = scales.tau_px**2
        gained = np.einsum("nk,nki,nij,nkj->", chances, z, self.B, z)
        spent = np.einsum("nk,nkij,nji->", chances, P, self.B)
        tau2 *= float((gained + _MODE_COUNT * lambda2 / tau2**2) / (spent + _MODE_COUNT / tau2))
        tau, lambda_, sigma = np.sqrt([max(tau2, lambda2), lambda2, sigma2]).tolist()
        return replace(updated, tau_px=tau, lambda_px=lambda_, sigma_px=sigma)

    def predicted(self, scales: Scales, covariance: Array) -> Array:
        """Predict the covariance (n, 6, 6) of m for ordinary views outside the fit of `covariance` (G, G)."""
        noise = scales.tau_px**2 * self.B + np.diag(scales.classes[0])
        return np.asarray(noise + self.J @ covariance @ np.swapaxes(self.J, 1, 2))

    def board_step(self, solved: LinearSolution) -> Array:
        """Compute the step (n, 6) of the board poses that belongs to the step of the shared unknowns."""
        pull = np.einsum("nk,nki->ni", solved.chances, solved.z)
        by_robot = np.einsum("nij,nkj,nk->ni", self.H, self.A, pull)
        step = -(solved.scales.tau_px**2) * by_robot
        if self.modes is not None:
            step += self.modes.to_optimum - self.modes.by_shared @ solved.step[self.modes.shared]
        return np.asarray(step)

    def seen_boards(self, C: Array) -> Array:
        """Move the board poses C (n, 4, 4), each to its own corners' optimum."""
        return C if self.modes is None else perturb(C, self.modes.to_optimum)

    def lost(self, solved: LinearSolution) -> Array:
        """Compute the information (G, G) lost because the views' classes are unknown (Louis 1982)."""
        mean = np.einsum("nk,nki->ni", solved.chances, solved.z)
        spread = np.einsum("nk,nki,nkj->nij", solved.chances, solved.z, solved.z)
        spread -= mean[:, :, None] * mean[:, None, :]
        _, S_inverse = self._noise(solved.scales)
        W = np.einsum("nk,nkij->nij", solved.chances, S_inverse)
        # A view cannot lose more information than it gives.
        root = np.linalg.cholesky(W)
        inner = np.linalg.solve(root, np.swapaxes(np.linalg.solve(root, spread), 1, 2))
        values, vectors = np.linalg.eigh((inner + np.swapaxes(inner, 1, 2)) / 2)
        inner = (vectors * np.clip(values, 0.0, 1.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
        spread = root @ inner @ np.swapaxes(root, 1, 2)
        return _summed(self.J, spread @ self.J)

    def noise_parts(self, solved: LinearSolution, covariance: Array) -> Array:
        """Compute X's whitened variance (3,) from corners, robot translation and robot rotation."""
        _, S_inverse = self._noise(solved.scales)
        gain = covariance[:6] @ np.swapaxes(self.J, 1, 2)
        ordinary = solved.scales.classes[0]
        whiten = np.linalg.inv(covariance[:6, :6])
        parts = []
        for noise in (
            solved.scales.tau_px**2 * self.B,
            np.diag(ordinary * [1, 1, 1, 0, 0, 0]),
            np.diag(ordinary * [0, 0, 0, 1, 1, 1]),
        ):
            G = gain @ np.einsum("nk,nkij->nij", solved.chances, S_inverse)
            parts.append(float(np.einsum("xy,nyi,nij,nxj->", whiten, G, np.broadcast_to(noise, G.shape), G)))
        return np.array(parts)

    def covariance(self, solved: LinearSolution) -> Array:
        """Compute the posterior covariance (G, G), with the uncertainty of the views' classes."""
        return inverse_of(solved.precision - self.lost(solved))


def _chances(residual: Array, S: Array, S_inverse: Array, shares: Array) -> tuple[Array, Array]:
    """Compute the probabilities (n, K) of the classes and the log density (n,) of residuals (n, 6)."""
    square = np.einsum("ni,nkij,nj->nk", residual, S_inverse, residual)
    log = np.log(shares) - 0.5 * (square + np.linalg.slogdet(S)[1] + 6 * np.log(2 * np.pi))
    top = log.max(axis=1, keepdims=True)
    density = np.exp(log - top)
    total = density.sum(axis=1, keepdims=True)
    return density / total, (top + np.log(total))[:, 0]


def _summed(J: Array, WJ: Array) -> Array:
    """Sum Jᵀ·WJ (a, b) over the views, for J (n, 6, a) and WJ (n, 6, b)."""
    return np.asarray(J.reshape(-1, J.shape[-1]).T @ WJ.reshape(-1, WJ.shape[-1]))


def inverse_of(N: Array) -> Array:
    """Invert a symmetric positive matrix, scaled to ones first. LinAlgError where it is not.

    A direction that is undetermined up to rounding (two terms of a rational lens, say) gets a huge variance,
    not an infinite one.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    scaled = (N + N.T) / 2 * np.outer(scale, scale)
    try:
        values, vectors = np.linalg.eigh(scaled)
    except np.linalg.LinAlgError:  # LAPACK's divide and conquer fails for about one matrix in a thousand
        values, vectors = linalg.eigh(scaled, driver="ev")
    if not values[0] > -_ROUNDING:
        raise np.linalg.LinAlgError("some unknowns are left open")
    root = vectors * scale[:, None]
    return np.asarray((root / np.maximum(values, _ROUNDING)) @ root.T)
