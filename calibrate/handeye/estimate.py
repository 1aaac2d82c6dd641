"""The joint estimate of all unknowns of a cell, with robust weights for the views.

Gauss-Newton on one posterior (`linear`), noise scales by restricted maximum likelihood between the steps; at
most MAX_STEPS linearisations.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from calibrate.errors import BadViewsError
from calibrate.handeye.cell_state import CellState
from calibrate.handeye.corner_modes import STUDENT
from calibrate.handeye.linear import MAX_STEPS, Fit, Linear
from calibrate.handeye.noise_scales import WIDE, Scales
from calibrate.handeye.priors import KnownBefore, Priors
from calibrate.handeye.reprojection import corner_distance, corner_residuals
from calibrate.views.view_set import Observations
from recordings.geometry import Array

REJECTED = 0.05
"""A view is rejected where at most this probability is left that the robot's noise in it is up to three times
the ordinary one (the first two classes of `mixture.GAIN`)."""
FULL = 0.35
"""Probability of the class of ordinary noise above which a view counts fully."""
SETTLED = 0.01
"""Step length, in sigmas of all unknowns together, below which the iteration has converged."""
NEARLY_SETTLED = 0.1
"""The same for a part of the views, which is fitted only to predict the others: a tenth of a sigma is not
seen in how far these are missed."""


@dataclass(frozen=True, eq=False)
class MixtureParts:
    """Components of the mixture of normal distributions that an estimate averages over.

    A mixture has heavier tails than one normal distribution, so its 95 % region is wider.
    """

    chances: Array = field(default_factory=lambda: np.ones(1))
    """(s,) weights of the components, sum 1."""
    camera_ratio: Array = field(default_factory=lambda: np.ones(1))
    """(s,) variance of X in each component over that of the mixture."""


@dataclass(frozen=True, eq=False)
class Estimate:
    state: CellState
    scales: Scales
    chances: Array
    """(n, K) probability of each noise class, per view."""
    weight: Array
    """(n,) 1: the view counts fully, 0: not at all."""
    covariance: Array
    """(G, G) posterior of the shared unknowns, in the order of `Layout`."""
    robot: Array
    """(n, 6) residuals at the optimum: implied minus recorded flange, the board seen by its corners alone."""
    robot_covariance: Array
    """(n, 6, 6) covariance of `robot` for an ordinary view that took no part in the fit."""
    board_poses: Array
    """(n, 4, 4) camera_from_board by each view's corners alone, with the final lens and shape."""
    corner_weights: Array
    """(n, k) in 0 … 1"""
    noise_parts: Array
    """(3,) variance of X by the noise of corners, robot translation and robot rotation: each the trace of its
    covariance (6, 6) after X's own covariance is made the unit matrix."""
    log_evidence: float
    converged: bool
    mixture: MixtureParts = field(default_factory=MixtureParts)
    """One part: the posterior is taken as one normal distribution."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """Mask (n,) of the views that are not rejected."""
        return np.asarray(self.chances[:, :2].sum(axis=1) > REJECTED)

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the noise estimate: 3n - 6 of n views that count."""
        return max(3.0 * float(self.chances[:, 0].sum()) - 6.0, 1.0)

    @property
    def threshold(self) -> float:
        """Limit of δᵀ C⁻¹ δ that holds the true X with 95 %: 6·F(6, ν), ν = 3n - 6 of n views that count."""
        freedom, chances, ratio = self.freedom, self.mixture.chances, self.mixture.camera_ratio
        one = float(6 * special.fdtri(6, freedom, 0.95))
        if len(chances) == 1:
            return one

        def outside(limit: float) -> float:
            return float(chances @ special.fdtr(6, freedom, limit / (6 * ratio))) - 0.95

        return float(optimize.brentq(outside, 0.9 * one * ratio.min(), 1.1 * one * ratio.max()))

    @property
    def freedom_of_region(self) -> float:
        """ν of the F(6, ν) that has this `threshold`: below `freedom` by a mixture's heavier tails."""
        return min(self.freedom, float(special.fdtridfd(6, 0.95, self.threshold / 6)))


def estimate(
    observed: Observations,
    start: CellState,
    priors: Priors | KnownBefore,
    scales: Scales | None = None,
    wide: float = WIDE,
    fit: Fit = "all",
    settled: float = SETTLED,
) -> Estimate:
    """Find the maximum of the posterior from `start`.

    scales: the noise to start from, of which `fit` says what is fitted; None: from the residuals at `start`,
    the robot's times `wide`. settled: step length, in sigmas, below which it ends.
    Raises BadViewsError where views and priors together do not determine the unknowns.
    """
    state, converged = start, False
    weights = observed.present if scales is None else corner_weights(observed, state, scales.sigma_px)
    linear = Linear.at(observed, state, weights)
    scales = scales or linear.first_scales(wide)
    try:
        for _ in range(MAX_STEPS):
            solved = linear.solve(priors.linearise(state, scales.arm_error_sigma), scales, fit)
            scales = solved.scales
            state = state.moved(solved.step, linear.board_step(solved))
            weights = corner_weights(observed, state, scales.sigma_px)
            converged = bool(solved.step @ solved.precision @ solved.step < settled**2)
            linear = Linear.at(observed, state, weights)
            if converged:
                break
        solved = linear.solve(priors.linearise(state, scales.arm_error_sigma), scales, "nothing")
        covariance = linear.covariance(solved)
    except np.linalg.LinAlgError as problem:
        raise BadViewsError("pose-open", reason=str(problem)) from None
    return Estimate(
        state=state,
        scales=scales,
        chances=solved.chances,
        weight=linear.weights(solved.chances, scales),
        covariance=covariance,
        robot=solved.residual,
        robot_covariance=linear.predicted(scales, covariance),
        board_poses=linear.seen_boards(state.C),
        corner_weights=weights,
        noise_parts=linear.noise_parts(solved, covariance),
        log_evidence=solved.log_evidence,
        converged=converged,
    )


def corner_weights(observed: Observations, state: CellState, sigma_px: float) -> Array:
    """Compute weights (n, k) of corners from Student's t distribution of their residuals; 0 for padding."""
    if not observed.has_pixels:
        return observed.present
    distance = corner_distance(corner_residuals(observed, state.camera, state.C, state.shape))
    square = (np.nan_to_num(distance, nan=1e6, posinf=1e6) / sigma_px) ** 2
    return (STUDENT + 2) / (STUDENT + square) * observed.present
