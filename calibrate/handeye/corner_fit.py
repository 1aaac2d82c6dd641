"""Least squares over the corners alone, without the robot: board poses, with the lens or for a given one.

K. Levenberg (1944), D. Marquardt (1963). Each view is a problem of its own, and all are solved at once; with
the lens among the unknowns they are one problem, whose board poses are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.handeye.priors import LensPrior
from calibrate.handeye.reprojection import corner_distance, corner_residuals, linearise_corners
from calibrate.views.projection import intrinsics_vector, with_intrinsics_vector
from calibrate.views.view_set import Observations
from recordings.geometry import Array, perturb
from recordings.schema.messages import CameraModel

_STEPS = 60
_SETTLED = 1e-9
"""The fit has converged when a step lowers the squares by no more than this share of them: it was about a
thousandth of a sigma, and the next would be far smaller."""
_DAMPING, _LARGEST_DAMPING = 1e-9, 1e9
"""Levenberg-Marquardt's damping: at the start, which it never falls below, and where a view's fit ends."""
_CORNER_PX = 0.3
"""1σ of a corner that is assumed where corners and the prior of the lens are weighed against each other."""
_FAR = 4.0
"""A corner loses weight from this multiple of the median distance, in its view, from where the fit has it."""


@dataclass(frozen=True, eq=False)
class CornerFit:
    camera: CameraModel
    C: Array
    """(n, 4, 4) camera_from_board"""
    rms_px: Array
    """(n,) rms distance of the corners from where the fit shows them."""


def fit_corners(
    observed: Observations,
    camera: CameraModel,
    C: Array,
    prior: LensPrior | None = None,
    shape: Array | None = None,
    robust: bool = False,
) -> CornerFit:
    """Fit board poses, starting at C (n, 4, 4), to each view's own corners.

    prior: what is known of the lens, which is then fitted, too; None: `camera` is right. shape: (5,) that of
    the board. robust: corners that lie far off count less. A view whose corners are behind the camera at C
    stays there.
    """
    n, C = len(observed), C.copy()
    if not observed.has_pixels:
        return CornerFit(camera, C, np.zeros(n))
    damping, going = np.full(n, _DAMPING), np.arange(n)

    def cost(weights: Array, residual: Array, camera: CameraModel) -> Array:
        """Weighted squares (m,), px²; where the lens is fitted, too, all together and with its prior."""
        square = np.asarray(np.einsum("nk,nki,nki->n", weights, residual, residual))
        if prior is None:
            return square
        miss = (intrinsics_vector(camera) - prior.mean) / prior.sigma
        return np.full(n, square.sum() + _CORNER_PX**2 * float(miss @ miss))

    for _ in range(_STEPS):
        some, poses = observed.part(going), C[going]
        residual = corner_residuals(some, camera, poses, shape)
        weights = _without_far(some, residual) if robust else some.present
        blocks = linearise_corners(some, camera, poses, weights, prior is not None, shape)
        damped = (1e-9 + damping[going, None, None] * blocks.LL) * np.eye(6)
        board_free = blocks.without_boards(np.asarray(np.linalg.inv(blocks.LL + damped)))
        shared, ahead_camera = np.zeros(blocks.GG.shape[1]), camera
        if prior is not None:
            vector, precision = intrinsics_vector(camera), _CORNER_PX**2 / prior.sigma**2
            GG = damping[0] * np.diag(blocks.GG.sum(axis=0)) + precision
            N = board_free.information.sum(axis=0) + np.diag(GG)
            shared = np.linalg.solve(N, board_free.right.sum(axis=0) - precision * (vector - prior.mean))
            if (vector + shared)[:2].min() > 0:
                ahead_camera = with_intrinsics_vector(camera, vector + shared)
            else:  # no camera has a negative focal length: a shorter step
                shared[:] = np.nan
        ahead = perturb(poses, board_free.board_step(shared))
        before = cost(weights, residual, camera)
        after = cost(weights, corner_residuals(some, ahead_camera, ahead, shape), ahead_camera)
        better = after <= before
        C[going[better]] = ahead[better]
        if better.all():
            camera = ahead_camera
        damping[going] = np.where(better, np.maximum(damping[going] / 10, _DAMPING), damping[going] * 30)
        settled = better & (before - after <= _SETTLED * before)
        going = going[~settled & (damping[going] < _LARGEST_DAMPING)]
        if not len(going):
            break
    square = np.square(corner_residuals(observed, camera, C, shape)).sum(axis=(1, 2))
    return CornerFit(camera, C, np.sqrt(square / observed.present.sum(axis=1)))


def _without_far(observed: Observations, residual: Array) -> Array:
    """Compute weights (n, k) of corners for `residual` (n, k, 2), by the median distance in each view."""
    distance = np.nan_to_num(corner_distance(residual), nan=1e6)
    typical = np.nanmedian(np.where(observed.present > 0, distance, np.nan), axis=1, keepdims=True)
    near = _FAR * np.maximum(typical, 0.01)
    return np.asarray(np.minimum(1.0, near / np.maximum(distance, near)) ** 2 * observed.present)
