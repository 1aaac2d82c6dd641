"""Board poses of all views by their own corners alone, robustly, and how well each is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.geometry import Array, perturb
from calibrate.likelihood.model import Observations, State
from calibrate.likelihood.normal import CORNERS
from calibrate.likelihood.residuals import corner_distance, corner_residuals, linearise_corners

_STEPS = 10
_LIMIT_SIGMA = 4.0


@dataclass(frozen=True, eq=False)
class BoardPoses:
    C: Array
    """(n, 4, 4) camera_from_board"""
    covariance: Array
    """(n, 6, 6) for corners of 1 px standard deviation; zeros where poses came without pixels."""
    typical_px: Array
    """(n,) median distance of the corners from the model: blind to a few bad corners."""
    rms_px: Array
    """(n,) root mean square over all corners."""


def refine_board_poses(observed: Observations, state: State) -> BoardPoses:
    """Least squares per view from `state`, far corners weighed down view by view."""
    if not observed.has_pixels:
        n = len(state.C)
        return BoardPoses(state.C, np.zeros((n, 6, 6)), np.zeros(n), np.zeros(n))
    for step in range(_STEPS):
        distance = np.nan_to_num(corner_distance(corner_residuals(observed, state)), nan=1e6)
        limit = _LIMIT_SIGMA * np.maximum(_typical(distance, observed.present), 0.01)[:, None]
        weights = np.where(distance > limit, (limit / np.maximum(distance, limit)) ** 2, 1.0)
        normal = linearise_corners(observed, state, weights)
        inverse = np.linalg.inv(normal.V[CORNERS] + 1e-9 * np.eye(6))
        delta = np.einsum("nij,nj->ni", inverse, normal.h[CORNERS])
        length = np.linalg.norm(delta, axis=1, keepdims=True)
        delta *= np.minimum(1.0, 0.2 / np.maximum(length, 1e-12))
        state = State(state.X, state.Y, perturb(state.C, delta), state.camera, state.theta)
        if step >= 1 and length.max() < 1e-9:
            break
    distance = np.nan_to_num(corner_distance(corner_residuals(observed, state)), nan=1e6)
    count = np.maximum(observed.present.sum(axis=1), 1.0)
    rms = np.sqrt((distance**2 * observed.present).sum(axis=1) / count)
    return BoardPoses(state.C, np.asarray(inverse), _typical(distance, observed.present), rms)


def _typical(distance: Array, present: Array) -> Array:
    """Median per view over its own corners (n,)."""
    if present.all():
        return np.asarray(np.median(distance, axis=1))
    return np.asarray(np.nanmedian(np.where(present > 0, distance, np.nan), axis=1))
