"""Final estimate: joint maximum likelihood of X, board place, board poses, noise and, if asked, the lens.

Gauss-Newton on the exact derivatives, corners held down beyond 4 σ, noise scales by REML between the
steps. At most MAX_STEPS linearisations: bounded time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from calibrate.assess import board_places, mean_pose
from calibrate.errors import BadViewsError
from calibrate.geometry import Array
from calibrate.likelihood.model import Observations, State
from calibrate.likelihood.noise import FLOOR, reml_scales
from calibrate.likelihood.normal import PRIOR, ROBOT_ROTATION, ROBOT_TRANSLATION, Normal, Solved
from calibrate.likelihood.residuals import (
    Misses,
    corner_residuals,
    linearise,
    misses,
    robot_residuals,
)
from calibrate.projection import INTRINSICS
from recordings.messages import CameraModel

MAX_STEPS = 25
_CORNER_LIMIT_SIGMA = 4.0
"""A corner farther out is weighed down by (limit/distance)²; of 1000 Gaussian corners 0.3 are."""


@dataclass(frozen=True, eq=False)
class Estimate:
    state: State
    sigma: Array
    """(4,) corner px, robot m, robot rad, kinematic scale."""
    joint_covariance: Array
    """(12 + p, 12 + p) of X, Y and the kinematic errors."""
    weights: Array
    """(n, k) of the corners."""
    normal: Normal
    steps: int
    converged: bool
    intrinsics_free: bool

    @property
    def covariance(self) -> Array:
        """(6, 6) of X."""
        return self.joint_covariance[:6, :6]

    @property
    def shares(self) -> dict[str, float]:
        """Share of X's variance by source (mean over directions), sums to 1."""
        return _shares(self.normal, self.normal.solve(self.sigma**-2), self.sigma, self.intrinsics_free)

    @property
    def threshold(self) -> float:
        """95 % ellipsoid δᵀ C⁻¹ δ: 6·F(6, ν), ν = 3N - 6 as the scales come from N robot poses.

        With kinematic errors their scale dominates and is known worst: then ν is the number of them that
        the data leave free (24 minus the trace), if that is less.
        """
        freedom = float(self.normal.count[[ROBOT_TRANSLATION, ROBOT_ROTATION]].mean()) - 6.0
        if len(self.state.theta):
            precision = self.sigma**-2
            used = self.normal.solve(precision).traces() * precision
            freedom = min(freedom, float(self.normal.count[PRIOR] - used[PRIOR]))
        return float(6 * stats.f.ppf(0.95, 6, max(freedom, 1.0)))


def first_state(observed: Observations, X: Array, C: Array, H: Array, camera: CameraModel) -> State:
    """Start: X from the certified solver, C from PnP, the mean place of the board."""
    count = 0 if observed.kinematics is None else observed.kinematics.shape[2]
    return State(X, mean_pose(board_places(H, C, X)), C, camera, np.zeros(count))


def first_sigma(observed: Observations, state: State) -> Array:
    """Start of the scales: medians of the residuals as they are."""
    e = robot_residuals(observed, state)
    corners = corner_residuals(observed, state)[observed.present > 0]
    sigma_px = 1.48 * float(np.median(np.abs(corners))) if len(corners) else 1.0
    robot = [1.48 * float(np.median(np.abs(part))) for part in (e[:, :3], e[:, 3:])]
    return np.asarray(np.maximum([sigma_px, *robot, 1.0], FLOOR), dtype=float)


def estimate(
    observed: Observations,
    start: State,
    intrinsics_free: bool = False,
    sigma: Array | None = None,
    fit_scales: bool = True,
) -> Estimate:
    """Maximum likelihood from `start`; `fit_scales` False keeps `sigma` as given.

    Raises BadViewsError where the views do not determine the parameters.
    """
    intrinsics_free = intrinsics_free and observed.has_pixels
    state, missed = start, misses(observed, start)
    sigma = first_sigma(observed, state) if sigma is None else sigma
    steps, converged = 0, False
    try:
        while steps < MAX_STEPS and not converged:
            steps += 1
            weights = corner_weights(observed, missed, sigma[0])
            normal = linearise(observed, state, weights, intrinsics_free)
            previous = sigma
            if fit_scales:
                sigma = reml_scales(normal, sigma, observed.has_pixels)
            solved = normal.solve(sigma**-2)
            state, missed = _step(observed, state, missed, solved, sigma, intrinsics_free)
            steady = np.abs(np.log(sigma / previous)).max() < 1e-3
            converged = bool(steady and _in_sigmas(solved) < 1e-3)
        weights = corner_weights(observed, missed, sigma[0])
        normal = linearise(observed, state, weights, intrinsics_free)
        solved = normal.solve(sigma**-2)
    except np.linalg.LinAlgError as error:
        raise BadViewsError(
            f"The final estimate failed: {error}. The views do not determine camera and lens together; "
            "record more poses, tilted about two axes, or give the intrinsics."
        ) from error
    return Estimate(
        state=state,
        sigma=sigma,
        joint_covariance=_without_intrinsics(solved.covariance, intrinsics_free),
        weights=weights,
        normal=normal,
        steps=steps,
        converged=converged,
        intrinsics_free=intrinsics_free,
    )


def corner_weights(observed: Observations, missed: Misses, sigma_px: float) -> Array:
    """(n, k): 1 up to the limit, then falling with the square of the distance; 0 for padding."""
    distance = np.nan_to_num(missed.distance_px, nan=np.inf, posinf=np.inf)
    limit = _CORNER_LIMIT_SIGMA * sigma_px
    return np.where(distance > limit, (limit / np.maximum(distance, limit)) ** 2, 1.0) * observed.present


def _step(
    observed: Observations,
    state: State,
    missed: Misses,
    solved: Solved,
    sigma: Array,
    intrinsics_free: bool,
) -> tuple[State, Misses]:
    """The Gauss-Newton step, halved while the weighed sum of squares would rise."""
    before = _cost(missed, state, sigma)
    for halving in range(6):
        factor = 0.5**halving
        trial = state.moved(factor * solved.step, factor * solved.by_view, intrinsics_free)
        ahead = misses(observed, trial)
        if _cost(ahead, trial, sigma) <= before * (1 + 1e-9) + 1e-9:
            return trial, ahead
    return state, missed


def _cost(missed: Misses, state: State, sigma: Array) -> float:
    """Robust sum: corners saturate like their weights do, (limit² (1 + 2 ln(d/limit)) beyond it)."""
    e = missed.robot / np.repeat(sigma[1:3], 3)
    d = missed.distance_px / sigma[0]
    d = np.where(np.isfinite(d), d, 1e6)
    over = np.maximum(d / _CORNER_LIMIT_SIGMA, 1.0)
    corners = np.minimum(d, _CORNER_LIMIT_SIGMA) ** 2 + 2 * _CORNER_LIMIT_SIGMA**2 * np.log(over)
    prior = float(state.theta @ state.theta) / sigma[3] ** 2
    return float((e**2).sum() + corners.sum() + prior)


def _in_sigmas(solved: Solved) -> float:
    """Length of the step in X and Y in sigmas."""
    step, covariance = solved.step[:12], solved.covariance[:12, :12]
    square = float(step @ np.linalg.solve(covariance, step))
    return float(np.sqrt(max(0.0, square) / 12))


def _shares(normal: Normal, solved: Solved, sigma: Array, intrinsics_free: bool) -> dict[str, float]:
    """Where X's variance comes from, as the mean over directions (trace after whitening).

    The covariance is the sum of one part per source. What free intrinsics add is counted apart: the
    share that would vanish if they were known.
    """
    whiten = np.linalg.inv(solved.covariance[:6, :6])
    parts = solved.contributions(sigma**-2)
    intrinsics = 0.0
    if intrinsics_free:
        known = _without(normal, slice(12, 12 + len(INTRINSICS))).solve(sigma**-2)
        parts = known.contributions(sigma**-2)
        intrinsics = 1.0 - float(np.einsum("ij,ji", whiten, known.covariance[:6, :6])) / 6
    share = [float(np.einsum("ij,ji", whiten, part)) / 6 for part in parts]
    names = ("corners", "robot_translation", "robot_rotation", "kinematics")
    return {**dict(zip(names, share, strict=True)), "intrinsics": intrinsics}


def _without(normal: Normal, columns: slice) -> Normal:
    """The same equations with some global parameters held."""
    keep = np.delete(np.arange(normal.size), columns)
    return replace(normal, U=normal.U[:, keep][:, :, keep], W=normal.W[:, :, keep], g=normal.g[:, keep])


def _without_intrinsics(covariance: Array, intrinsics_free: bool) -> Array:
    keep = np.delete(np.arange(len(covariance)), slice(12, 21 if intrinsics_free else 12))
    part = covariance[np.ix_(keep, keep)]
    return np.asarray((part + part.T) / 2)
