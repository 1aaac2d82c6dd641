"""Residuals and their exact derivatives, gathered per source of noise into normal equations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calibrate.geometry import Array, difference, inverse, skew
from calibrate.likelihood.model import Observations, State
from calibrate.likelihood.normal import CORNERS, PRIOR, ROBOT_ROTATION, ROBOT_TRANSLATION, Normal
from calibrate.projection import project, project_pixels
from recordings.messages import Mount

_CHUNK_POINTS = 40_000
"""Corners linearised at once: bounds memory for thousands of views."""


@dataclass(frozen=True, eq=False)
class Misses:
    """What a state leaves unexplained."""

    robot: Array
    """(n, 6), each by what it is worth."""
    distance_px: Array
    """(n, k) of the corners, 0 for padding; not finite for corners behind the camera."""


def misses(observed: Observations, state: State) -> Misses:
    robot = observed.worths * robot_residuals(observed, state)
    return Misses(robot, corner_distance(corner_residuals(observed, state)))


def corner_distance(residuals: Array) -> Array:
    """(..., 2) → (...): np.linalg.norm's numbers in a third of its time."""
    square = residuals * residuals
    return np.asarray(np.sqrt(square[..., 0] + square[..., 1]))


def corner_residuals(observed: Observations, state: State) -> Array:
    """Observed minus modelled pixels (n, k, 2), 0 for padding."""
    if not observed.has_pixels:
        return np.zeros_like(observed.pixels)
    p = observed.points @ np.swapaxes(state.C[:, :3, :3], 1, 2) + state.C[:, None, :3, 3]
    p = np.where(observed.present[..., None] > 0, p, [0.0, 0.0, 1.0])
    return np.where(observed.present[..., None] > 0, observed.pixels - project_pixels(state.camera, p), 0.0)


def modelled_flange(observed: Observations, state: State) -> Array:
    """base_from_flange (n, 4, 4) that X, Y and C imply."""
    if observed.mount == "eye-in-hand":
        return np.asarray(state.Y @ inverse(state.C) @ inverse(state.X))
    return np.asarray(state.X @ state.C @ inverse(state.Y))


def robot_residuals(observed: Observations, state: State) -> Array:
    """(n, 6) [δt, δφ] modelled flange against the recorded one, kinematic errors θ taken out."""
    return _without_kinematics(observed, state, difference(modelled_flange(observed, state), observed.flange))


def _without_kinematics(observed: Observations, state: State, miss: Array) -> Array:
    return miss if observed.kinematics is None else miss - observed.kinematics @ state.theta


def linearise(observed: Observations, state: State, weights: Array, intrinsics_free: bool) -> Normal:
    """Normal equations at `state`; `weights` (n, k) in 0…1 hold down bad corners."""
    kinematic = 0 if observed.kinematics is None else observed.kinematics.shape[2]
    normal = Normal.empty(len(state.C), 12 + 9 * intrinsics_free + kinematic)
    _add_corners(normal, observed, state, weights * observed.present, intrinsics_free)
    _add_robot(normal, observed, state)
    if kinematic:
        place = np.arange(normal.size - kinematic, normal.size)
        normal.U[PRIOR][place, place] = 1.0
        normal.g[PRIOR][place] = -state.theta
        normal.square[PRIOR] = float(state.theta @ state.theta)
        normal.count[PRIOR] = kinematic
    return normal


def linearise_corners(
    observed: Observations, state: State, weights: Array, intrinsics_free: bool = False
) -> Normal:
    """The same of the corners alone: what board poses and lens follow from without the robot."""
    normal = Normal.empty(len(state.C), 12 + 9 * intrinsics_free)
    _add_corners(normal, observed, state, weights * observed.present, intrinsics_free)
    return normal


def _add_corners(
    normal: Normal, observed: Observations, state: State, weights: Array, intrinsics_free: bool
) -> None:
    if not observed.has_pixels:
        normal.V[CORNERS] = 1e14 * np.eye(6)  # board poses given, not seen: taken as exact
        return
    step = max(1, _CHUNK_POINTS // observed.points.shape[1])
    for start in range(0, len(state.C), step):
        part = slice(start, start + step)
        _add_corner_chunk(normal, observed, state, weights, intrinsics_free, part)
    normal.count[CORNERS] = 2 * float(weights.sum())
    if intrinsics_free and observed.held:
        # One equation "no change" for each: it uses up the residual it adds, so the scales do not notice.
        place = 12 + np.array(observed.held)
        normal.U[CORNERS][place, place] = 1.0
        normal.count[CORNERS] += len(observed.held)


def _add_corner_chunk(
    normal: Normal,
    observed: Observations,
    state: State,
    weights: Array,
    intrinsics_free: bool,
    part: slice,
) -> None:
    C, present = state.C[part], observed.present[part, :, None] > 0
    turned = observed.points[part] @ np.swapaxes(C[:, :3, :3], 1, 2)
    p = np.where(present, turned + C[:, None, :3, 3], [0.0, 0.0, 1.0])
    projected = project(state.camera, p, with_intrinsics=intrinsics_free)
    root = np.sqrt(weights[part])[..., None]
    n = len(C)
    residual = (np.where(present, observed.pixels[part] - projected.pixels, 0.0) * root).reshape(n, -1)
    J = np.concatenate([projected.by_point, projected.by_point @ -skew(turned)], axis=-1)
    J = (J * root[..., None]).reshape(n, -1, 6)
    J_t = np.swapaxes(J, 1, 2)
    normal.V[CORNERS, part] = J_t @ J
    normal.h[CORNERS, part] = (J_t @ residual[..., None])[..., 0]
    normal.square[CORNERS] += float((residual**2).sum())
    if projected.by_intrinsics is not None:
        J_K = (projected.by_intrinsics * root[..., None]).reshape(n, -1, 9)
        J_K[..., list(observed.held)] = 0.0
        normal.W[CORNERS, part, 12:21] = np.swapaxes(J_K, 1, 2) @ J
        flat = J_K.reshape(-1, 9)
        normal.U[CORNERS, 12:21, 12:21] += flat.T @ flat
        normal.g[CORNERS, 12:21] += flat.T @ residual.reshape(-1)


def _add_robot(normal: Normal, observed: Observations, state: State) -> None:
    modelled = modelled_flange(observed, state)
    miss = difference(modelled, observed.flange)
    e = _without_kinematics(observed, state, miss)
    by_X, by_Y, by_C = _robot_derivatives(observed.mount, state, modelled, miss)
    J_G = np.zeros((len(e), 6, normal.size))
    J_G[..., :6], J_G[..., 6:12] = by_X, by_Y
    if observed.kinematics is not None:
        J_G[..., -observed.kinematics.shape[2] :] = -observed.kinematics
    worth = observed.worths
    e, by_C, J_G = e * worth, by_C * worth[..., None], J_G * worth[..., None]
    for group, rows in ((ROBOT_TRANSLATION, slice(0, 3)), (ROBOT_ROTATION, slice(3, 6))):
        G, c, r = J_G[:, rows], by_C[:, rows], e[:, rows]
        flat = G.reshape(-1, normal.size)
        normal.U[group] = flat.T @ flat
        normal.g[group] = -flat.T @ r.reshape(-1)
        normal.V[group] = np.swapaxes(c, 1, 2) @ c
        normal.W[group] = np.swapaxes(G, 1, 2) @ c
        normal.h[group] = -np.einsum("nri,nr->ni", c, r)
        normal.square[group] = float((r**2).sum())
        normal.count[group] = float((worth[:, rows] ** 2).sum())


def robot_derivatives(observed: Observations, state: State) -> tuple[Array, Array, Array]:
    """∂residual/∂X, ∂Y, ∂C: each (n, 6, 6), of `perturb`'s deltas."""
    modelled = modelled_flange(observed, state)
    return _robot_derivatives(observed.mount, state, modelled, difference(modelled, observed.flange))


def _robot_derivatives(mount: Mount, state: State, F: Array, miss: Array) -> tuple[Array, Array, Array]:
    n = len(state.C)
    R_F, R_C, t_C = F[:, :3, :3], state.C[:, :3, :3], state.C[:, :3, 3]
    eye_in_hand = mount == "eye-in-hand"
    near, far = (state.Y, state.X) if eye_in_hand else (state.X, state.Y)
    # F = near · M · far⁻¹ with M = C⁻¹ or C, and a = M's image of far's origin
    R_near, R_far, t_far = near[:3, :3], far[:3, :3], far[:3, 3]
    in_board = R_far.T @ t_far
    if eye_in_hand:
        turn = R_near @ np.swapaxes(R_C, 1, 2)
        arm = in_board + t_C
        by_C_tt, by_C_tr, by_C_rr = -turn, -turn @ skew(arm), -turn
        lever = -np.einsum("nij,nj->ni", turn, arm)
    else:
        turn = np.broadcast_to(R_near, (n, 3, 3))
        arm = np.einsum("nij,j->ni", R_C, in_board)
        by_C_tt, by_C_tr, by_C_rr = turn, turn @ skew(arm), turn
        lever = (t_C - arm) @ R_near.T
    zero, eye = np.zeros((n, 3, 3)), np.broadcast_to(np.eye(3), (n, 3, 3))
    by_near = _blocks(eye, -skew(lever), zero, eye)
    by_far = _blocks(-R_F, -R_F @ skew(t_far), zero, -R_F)
    by_C = _blocks(by_C_tt, by_C_tr, zero, by_C_rr)
    bend = _inverse_left_jacobian(miss[:, 3:])
    for J in (by_near, by_far, by_C):
        J[:, 3:] = bend @ J[:, 3:]
    return (by_far, by_near, by_C) if eye_in_hand else (by_near, by_far, by_C)


def _blocks(tt: Array, tr: Array, rt: Array, rr: Array) -> Array:
    top, bottom = np.concatenate([tt, tr], axis=-1), np.concatenate([rt, rr], axis=-1)
    return np.concatenate([top, bottom], axis=-2)


def _inverse_left_jacobian(v: Array) -> Any:
    """∂Log(Exp(δ) Exp(v))/∂δ at 0, (n, 3) → (n, 3, 3)."""
    angle = np.linalg.norm(v, axis=1)
    half = np.maximum(angle / 2, 1e-6)
    c = np.where(angle < 1e-4, 1 / 12, (1 - half / np.tan(half)) / (4 * half * half))
    S = skew(v)
    return np.eye(3) - S / 2 + c[:, None, None] * (S @ S)
