"""The recorded flange against the one that X, the board's pose and the picture imply."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibrate.geometry import Array, difference, inverse, skew
from calibrate.handeye.observations import Observations, State
from recordings.schema.messages import Mount


def implied_flange(mount: Mount, X: Array, Y: Array, C: Array) -> Array:
    """base_from_flange (n, 4, 4): Y C⁻¹ X⁻¹ (eye-in-hand) or X C Y⁻¹ (eye-to-hand)."""
    if mount == "eye-in-hand":
        return np.asarray(Y @ inverse(C) @ inverse(X))
    return np.asarray(X @ C @ inverse(Y))


def flange_residuals(observed: Observations, state: State) -> Array:
    """(n, 6) [δt, δφ] in base: implied minus recorded flange, errors of the kinematic table taken out."""
    X, Y = state.poses(observed)
    miss = difference(implied_flange(observed.mount, X, Y, state.C), observed.flange)
    return miss if observed.table is None or not len(state.table) else miss - observed.table @ state.table


def flange_derivatives(mount: Mount, X: Array, Y: Array, C: Array, miss: Array) -> tuple[Array, Array, Array]:
    """∂residual/∂X, ∂Y, ∂C (n, 6, 6) of `perturb`'s deltas.

    X and Y: (4, 4), or (n, 4, 4) where they differ from view to view; C (n, 4, 4); miss: (n, 6), the residual
    without errors of the kinematic table.
    """
    eye_in_hand = mount == "eye-in-hand"
    F = implied_flange(mount, X, Y, C)
    near, far = (Y, X) if eye_in_hand else (X, Y)
    R_F, R_C, t_C = F[:, :3, :3], C[:, :3, :3], C[:, :3, 3]
    # F = near · M · far⁻¹ with M = C⁻¹ or C, and `arm` from M's child to far's origin
    R_near = np.broadcast_to(near[..., :3, :3], R_F.shape)
    t_far = np.broadcast_to(far[..., :3, 3], t_C.shape)
    in_far = np.einsum("...ji,...j->...i", far[..., :3, :3], far[..., :3, 3])
    zero, eye = np.zeros(R_F.shape), np.broadcast_to(np.eye(3), R_F.shape)
    if eye_in_hand:
        turn = R_near @ np.swapaxes(R_C, 1, 2)
        arm = in_far + t_C
        by_C = _blocks(-turn, -turn @ skew(arm), zero, -turn)
        lever = -np.einsum("nij,nj->ni", turn, arm)
    else:
        arm = (R_C @ in_far[..., None])[..., 0]
        by_C = _blocks(R_near, R_near @ skew(arm), zero, R_near)
        lever = np.einsum("nij,nj->ni", R_near, t_C - arm)
    by_near = _blocks(eye, -skew(lever), zero, eye)
    by_far = _blocks(-R_F, -R_F @ skew(t_far), zero, -R_F)
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
