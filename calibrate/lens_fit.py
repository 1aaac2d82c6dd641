"""Lens and board poses together, by least squares over the corners alone: the last step of Zhang's method."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.errors import BadViewsError
from calibrate.geometry import Array, pose, rotation_exp
from calibrate.likelihood.model import Observations, State, observe_views
from calibrate.likelihood.normal import CORNERS, Normal
from calibrate.likelihood.residuals import corner_residuals, linearise_corners
from calibrate.projection import INTRINSICS, intrinsics_vector, with_intrinsics_vector
from calibrate.views import ViewSet
from recordings.messages import CameraModel

_STEPS = 60
_SETTLED = 1e-9
"""Relative gain after which the next step, by far smaller, is not worth taking: a thousandth of a sigma."""
_DAMPING, _LARGEST_DAMPING = 1e-9, 1e9
"""The first and least one; and where it ends."""
_LENS = slice(12, 21)
"""The place of `projection.INTRINSICS` among the global parameters of the normal equations."""


@dataclass(frozen=True, eq=False)
class LensFit:
    camera: CameraModel
    """plumb_bob"""
    camera_from_board: Array
    """(n, 4, 4)"""
    held: tuple[str, ...]
    sigma: Array
    """(9,) 1σ in the order of INTRINSICS, by the scatter of the corners; 0 for those held."""
    rms_px: float
    """Of the corners' distances."""
    view_rms_px: Array
    """(n,)"""


def first_fit(views: ViewSet) -> LensFit:
    """All nine parameters, from nothing. cv2.error or BadViewsError where the corners allow no guess."""
    size = (views.camera.width, views.camera.height)
    points = [view.board_points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    K = np.asarray(cv2.initCameraMatrix2D(points, pixels, size, 0), dtype=float)
    focal = np.where(np.isfinite(K[[0, 1], [0, 1]]), K[[0, 1], [0, 1]], max(size))
    focal = np.clip(focal, 0.1 * max(size), 100 * max(size))
    matrix = ((float(focal[0]), 0.0, (size[0] - 1) / 2), (0.0, float(focal[1]), (size[1] - 1) / 2))
    camera = CameraModel(*size, (*matrix, (0.0, 0.0, 1.0)), (0.0,) * 5)
    return _fit(views, camera, _first_poses(views, np.array(camera.matrix)), ())


def refit(views: ViewSet, before: LensFit, held: tuple[str, ...]) -> LensFit:
    """From an earlier fit of the same views; `held`: the centre in the middle, other parameters at 0."""
    vector = intrinsics_vector(before.camera)
    middle = {"cx": (before.camera.width - 1) / 2, "cy": (before.camera.height - 1) / 2}
    for name in held:
        vector[INTRINSICS.index(name)] = middle.get(name, 0.0)
    camera = with_intrinsics_vector(before.camera, vector)
    return _fit(views, camera, before.camera_from_board, held)


def reduced(normal: Normal, free: NDArray[np.intp]) -> tuple[Array, Array]:
    """The corners' normal equations of the `free` intrinsics (m), board poses eliminated: (m, m) and (m,)."""
    lens = _LENS.start + free
    W = normal.W[CORNERS][:, lens]
    elimination = W @ np.linalg.inv(normal.V[CORNERS])
    information = normal.U[CORNERS][np.ix_(lens, lens)] - np.tensordot(elimination, W, axes=([0, 2], [0, 2]))
    right = normal.g[CORNERS][lens] - np.einsum("nai,ni->a", elimination, normal.h[CORNERS])
    return information, right


def _first_poses(views: ViewSet, K: Array) -> Array:
    """(n, 4, 4): the likelier of the two tilts that each picture allows (IPPE); distortion is left out."""
    turns, shifts = np.zeros((2, len(views), 3))
    for i, view in enumerate(views):
        points, pixels = np.ascontiguousarray(view.board_points), np.ascontiguousarray(view.pixels)
        found, turn, shift = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
        if not found or not np.isfinite([turn, shift]).all():
            raise BadViewsError(f"view {view.name}: the corners do not fix a board pose")
        turns[i], shifts[i] = turn.ravel(), shift.ravel()
    return pose(rotation_exp(turns), shifts)


def _fit(views: ViewSet, camera: CameraModel, poses: Array, held: tuple[str, ...]) -> LensFit:
    """Levenberg-Marquardt: K. Levenberg (1944), D. Marquardt (1963).

    Steps that lead to absurd lenses overflow, and are not taken.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return _fitted(views, camera, poses, held)


def _fitted(views: ViewSet, camera: CameraModel, poses: Array, held: tuple[str, ...]) -> LensFit:
    observed = observe_views(replace(views, camera=camera, held_intrinsics=held))
    free = np.setdiff1d(np.arange(len(INTRINSICS)), observed.held)
    state = State(np.eye(4), np.eye(4), poses, camera, np.zeros(0))
    normal = linearise_corners(observed, state, observed.present, intrinsics_free=True)
    damping = _DAMPING
    for _ in range(_STEPS):
        trial = _moved(state, normal, free, damping)
        ahead = None if trial is None else linearise_corners(observed, trial, observed.present, True)
        before = normal.square[CORNERS]
        if trial is None or ahead is None or not ahead.square[CORNERS] <= before:
            damping *= 30
            if damping > _LARGEST_DAMPING:
                break
            continue
        state, normal = trial, ahead
        damping = max(damping / 10, _DAMPING)
        if before - normal.square[CORNERS] <= _SETTLED * before:
            break
    return _judged(observed, state, normal, free, held)


def _moved(state: State, normal: Normal, free: NDArray[np.intp], damping: float) -> State | None:
    """After a damped step; None where there is no such camera."""
    damped = replace(normal, U=normal.U.copy(), V=normal.V.copy())
    for block in (damped.U[CORNERS], damped.V[CORNERS]):
        diagonal = np.einsum("...ii->...i", block)
        diagonal *= 1 + damping
    try:
        information, right = reduced(damped, free)
        step = np.zeros(normal.size)
        step[_LENS.start + free] = np.linalg.solve(information, right)
        rest = normal.h[CORNERS] - np.einsum("nai,a->ni", normal.W[CORNERS], step)
        by_view = np.linalg.solve(damped.V[CORNERS], rest[..., None])[..., 0]
    except np.linalg.LinAlgError:
        return None
    focal = intrinsics_vector(state.camera)[:2] + step[_LENS][:2]
    if not (focal > 0).all() or not np.isfinite(by_view).all():
        return None
    return state.moved(step, by_view, intrinsics_free=True)


def _judged(
    observed: Observations, state: State, normal: Normal, free: NDArray[np.intp], held: tuple[str, ...]
) -> LensFit:
    square = (corner_residuals(observed, state) ** 2).sum(axis=-1)
    corners = observed.present.sum(axis=1)
    freedom = max(2 * float(corners.sum()) - len(free) - 6 * len(corners), 1.0)
    information, _ = reduced(normal, free)
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    # What is not determined at all has a huge sigma, not an infinite one.
    variance = (vectors**2 / np.maximum(values, 1e-16)).sum(axis=1) * scale**2
    sigma = np.zeros(len(INTRINSICS))
    sigma[free] = np.sqrt(variance * square.sum() / freedom)
    return LensFit(
        state.camera,
        state.C,
        held,
        sigma,
        float(np.sqrt(square.sum() / corners.sum())),
        np.sqrt(square.sum(axis=1) / corners),
    )
