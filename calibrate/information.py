"""What a set of views can tell: Fisher information of X, board place and intrinsics from geometry alone.

The model is that of the maximum-likelihood estimate: pixel noise on every corner, and on every robot
pose an independent error (translation and rotation, per axis) that is a nuisance of its own view.
Parameter order: δX (6), δY (6), then `projection.INTRINSICS` when they are free. Deltas are those of
`geometry.perturb`. X = flange_from_camera, Y = base_from_board (eye-in-hand), or
X = base_from_camera, Y = flange_from_board (eye-to-hand).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.geometry import Array, skew
from calibrate.projection import project
from recordings.messages import CameraModel, Mount


@dataclass(frozen=True)
class Noise:
    """Standard deviations per axis."""

    pixel_px: float = 0.15
    robot_m: float = 0.0001
    robot_rad: float = 0.00017


def lens_can_be_free(camera: CameraModel) -> bool:
    """The estimate refines only this model; other lenses count as known."""
    return camera.distortion_model == "plumb_bob"


def _chain(mount: Mount, E: Array, X: Array, Y: Array, points: Array) -> tuple[Array, Array, Array, Array]:
    """Points in camera, and their derivatives by δX, δY, δE: (n, k, 3), three times (n, k, 3, 6)."""
    Rx, tx, Ry, ty = X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3]
    Re, te = E[:, None, :3, :3], E[:, None, :3, 3]
    turned = points @ Ry.T
    if mount == "eye-in-hand":
        q = np.broadcast_to(turned + ty, (len(E), *points.shape))
        out = np.swapaxes(Re, -1, -2)  # base → flange
        near = np.einsum("nkij,nkj->nki", np.broadcast_to(out, (*q.shape, 3)), q - te)
        dE = np.concatenate([-np.broadcast_to(out, (*q.shape, 3)), out @ skew(q - te)], axis=-1)
        dY = np.concatenate([np.broadcast_to(out, (*q.shape, 3)), -out @ skew(turned)], axis=-1)
    else:
        f = turned + ty
        lever = np.einsum("nkij,kj->nki", np.broadcast_to(Re, (len(E), len(points), 3, 3)), f)
        near = lever + te
        eye = np.broadcast_to(np.eye(3), (*near.shape, 3))
        dE = np.concatenate([eye, -skew(lever)], axis=-1)
        dY = np.concatenate([np.broadcast_to(Re, (*near.shape, 3)), -Re @ skew(turned)], axis=-1)
    eye = np.broadcast_to(np.eye(3), (*near.shape, 3))
    dX = np.concatenate([-eye, skew(near - tx)], axis=-1)
    return (near - tx) @ Rx, Rx.T @ dX, Rx.T @ dY, Rx.T @ dE


def view_information(
    mount: Mount,
    camera: CameraModel,
    base_from_flange: Array,
    X: Array,
    Y: Array,
    board_points: Array,
    noise: Noise,
    free_intrinsics: bool,
) -> Array:
    """Information of each view, (n, p, p): p = 12, or 21 when the intrinsics are free (plumb_bob only).

    The view's own robot error is marginalised (Woodbury), so views simply add.
    """
    n, k = len(base_from_flange), len(board_points)
    points, dX, dY, dE = _chain(mount, base_from_flange, X, Y, board_points)
    seen = project(camera, points, with_intrinsics=free_intrinsics and lens_can_be_free(camera))
    by_point = seen.by_point
    blocks = [by_point @ dX, by_point @ dY]
    if seen.by_intrinsics is not None:
        blocks.append(seen.by_intrinsics)
    J = np.concatenate(blocks, axis=-1).reshape(n, 2 * k, -1) / noise.pixel_px
    G = (by_point @ dE).reshape(n, 2 * k, 6) / noise.pixel_px
    G = G * np.repeat([noise.robot_m, noise.robot_rad], 3)
    J_t, G_t = np.swapaxes(J, -1, -2), np.swapaxes(G, -1, -2)
    cross = G_t @ J
    return np.asarray(J_t @ J - np.swapaxes(cross, -1, -2) @ np.linalg.solve(np.eye(6) + G_t @ G, cross))


def covariance_of(information: Array, lens_prior: Array | None = None) -> Array:
    """Information (..., p, p) → covariance (..., p, p), scaled inside so that metres and pixels do not clash.

    `lens_prior` (p,) is added to the diagonal. Directions without information get a huge variance.
    """
    M = information + (np.diag(lens_prior) if lens_prior is not None else 0.0)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(M, axis1=-2, axis2=-1), 1e-12))
    scaled = M * scale[..., :, None] * scale[..., None, :]
    scaled = scaled + 1e-12 * np.eye(M.shape[-1])
    return np.asarray(np.linalg.inv(scaled) * scale[..., :, None] * scale[..., None, :])
