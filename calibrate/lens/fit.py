"""Lens and board poses together, by least squares over the corners alone: the last step of Zhang's method.

What the pictures leave open stays where the prior puts it (`handeye.priors`), so no parameter has to be held.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibrate.errors import BadViewsError
from calibrate.geometry import Array, perturb, pose, rotation_exp
from calibrate.handeye.corners import CornerBlocks, corner_residuals, linearise_corners
from calibrate.handeye.observations import Observations, observe_views
from calibrate.handeye.priors import LensPrior
from calibrate.lens.model import undistort
from calibrate.projection import intrinsics_vector, with_intrinsics_vector
from calibrate.views import ViewSet
from recordings.schema.messages import CameraModel

_STEPS = 60
_SETTLED = 1e-9
"""Relative gain after which the next step, by far smaller, is not worth taking: a thousandth of a sigma."""
_DAMPING, _LARGEST_DAMPING = 1e-9, 1e9
"""The first and least one; and where it ends."""
_CORNER_PX = 0.3
"""1σ of a corner against which the prior is weighed."""


@dataclass(frozen=True, eq=False)
class LensFit:
    camera: CameraModel
    camera_from_board: Array
    """(n, 4, 4)"""
    covariance: Array
    """(p, p) of the parameters, by the scatter of the corners and the prior."""
    rms_px: float
    """Of the corners' distances."""
    view_rms_px: Array
    """(n,)"""


def fit_lens(views: ViewSet, start: CameraModel) -> LensFit:
    """From a first guess of the lens. BadViewsError or cv2.error where the corners allow no fit."""
    observed = observe_views(views)
    prior = LensPrior.unknown(start)
    camera, C = start, _first_poses(views, start)
    blocks = linearise_corners(observed, camera, C, observed.present, with_lens=True)
    cost = _cost(blocks, prior, camera)
    damping = _DAMPING
    for _ in range(_STEPS):
        trial = _moved(blocks, prior, camera, C, damping)
        ahead, ahead_cost = None, np.inf
        if trial is not None:
            ahead = linearise_corners(observed, *trial, observed.present, with_lens=True)
            ahead_cost = _cost(ahead, prior, trial[0])
        if trial is None or ahead is None or not ahead_cost <= cost:
            damping *= 30
            if damping > _LARGEST_DAMPING:
                break
            continue
        (camera, C), blocks, before, cost = trial, ahead, cost, ahead_cost
        damping = max(damping / 10, _DAMPING)
        if before - cost <= _SETTLED * before:
            break
    return _judged(observed, blocks, prior, camera, C)


def first_guess(views: ViewSet) -> CameraModel:
    """Focal length from the boards' shapes in the picture, the centre in the middle, no distortion."""
    size = (views.camera.width, views.camera.height)
    points = [view.board_points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    K = np.asarray(cv2.initCameraMatrix2D(points, pixels, size, 0), dtype=float)
    focal = np.where(np.isfinite(K[[0, 1], [0, 1]]), K[[0, 1], [0, 1]], max(size))
    focal = np.clip(focal, 0.1 * max(size), 100 * max(size))
    matrix = ((float(focal[0]), 0.0, (size[0] - 1) / 2), (0.0, float(focal[1]), (size[1] - 1) / 2))
    return CameraModel(*size, (*matrix, (0.0, 0.0, 1.0)), (0.0,) * 5)


def _first_poses(views: ViewSet, camera: CameraModel) -> Array:
    """(n, 4, 4): the likelier of the two tilts that each picture allows (IPPE)."""
    K = np.array(camera.matrix)
    turns, shifts = np.zeros((2, len(views), 3))
    for i, view in enumerate(views):
        points = np.ascontiguousarray(view.board_points)
        pixels = np.ascontiguousarray(undistort(camera, view.pixels))
        found, turn, shift, _ = cv2.solvePnPGeneric(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            raise BadViewsError(f"view {view.index + 1} ({view.name}): the corners do not fix a board pose")
        turns[i], shifts[i] = turn[0].ravel(), shift[0].ravel()
    return pose(rotation_exp(turns), shifts)


def _prior_terms(prior: LensPrior, camera: CameraModel) -> tuple[Array, Array, float]:
    """Information (p, p), right-hand side (p,) and cost, all for corners of 1 px."""
    miss = intrinsics_vector(camera) - prior.mean
    precision = _CORNER_PX**2 * prior.sigma**-2.0
    return np.diag(precision), -precision * miss, float((precision * miss**2).sum())


def _cost(blocks: CornerBlocks, prior: LensPrior, camera: CameraModel) -> float:
    return float(blocks.rr.sum()) + _prior_terms(prior, camera)[2]


def _reduced(blocks: CornerBlocks, damping: float) -> tuple[Array, Array, Array, Array]:
    """Damped information (p, p) and right-hand side (p,) of the lens, H (n, 6, 6), H·LG."""
    LL, GG = blocks.LL.copy(), blocks.GG.sum(axis=0)
    for block in (LL, GG):
        diagonal = np.einsum("...ii->...i", block)
        diagonal *= 1 + damping
    H = np.asarray(np.linalg.inv(LL), dtype=float)
    HLG = H @ blocks.LG
    information = GG - np.einsum("nia,nib->ab", blocks.LG, HLG)
    right = blocks.Gr.sum(axis=0) - np.einsum("nia,ni->a", HLG, blocks.Lr)
    return information, right, H, HLG


def _moved(
    blocks: CornerBlocks, prior: LensPrior, camera: CameraModel, C: Array, damping: float
) -> tuple[CameraModel, Array] | None:
    """After a damped step; None where there is no such camera."""
    try:
        information, right, H, HLG = _reduced(blocks, damping)
        prior_information, prior_right, _ = _prior_terms(prior, camera)
        step = np.linalg.solve(information + prior_information, right + prior_right)
    except np.linalg.LinAlgError:
        return None
    by_view = np.einsum("nij,nj->ni", H, blocks.Lr) - HLG @ step
    vector = intrinsics_vector(camera) + step
    if not (vector[:2] > 0).all() or not np.isfinite(by_view).all():
        return None
    return with_intrinsics_vector(camera, vector), perturb(C, by_view)


def _judged(
    observed: Observations, blocks: CornerBlocks, prior: LensPrior, camera: CameraModel, C: Array
) -> LensFit:
    square = (corner_residuals(observed, camera, C) ** 2).sum(axis=-1)
    corners = observed.present.sum(axis=1)
    information, *_ = _reduced(blocks, 0.0)
    freedom = max(2 * float(corners.sum()) - len(information) - 6 * len(corners), 1.0)
    total = information * freedom / max(float(square.sum()), 1e-12) + np.diag(prior.sigma**-2.0)
    scale = 1 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    values, vectors = np.linalg.eigh(total * np.outer(scale, scale))
    # What is not determined at all has a huge sigma, not an infinite one.
    basis = vectors * scale[:, None]
    covariance = (basis / np.maximum(values, 1e-16)) @ basis.T
    return LensFit(
        camera,
        C,
        covariance,
        float(np.sqrt(square.sum() / corners.sum())),
        np.sqrt(square.sum(axis=1) / corners),
    )
