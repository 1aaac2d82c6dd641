"""An image as the deviation of the tag's pose from the one predicted by calibration, arm and tag pose.

The deviation r of the corners from the predicted ones is converted to the six numbers of the tag's pose in
the camera by one linear step, y = (LᵀL)⁻¹ Lᵀ r. No pose is solved from a single tag, whose tilt is ambiguous.
Deltas are those of `geometry.perturb`. Eye-in-hand: C = (F X)⁻¹ P; eye-to-hand: C = X⁻¹ F P.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.geometry import Array, inverse, perturb, skew, transform_points
from calibrate.kinematics import RobotModel, jacobian
from calibrate.projection import camera_matrix, project
from calibrate.views import board_in_camera
from recordings.schema.messages import CameraModel, Mount

DEAD_BAND_M, DEAD_BAND_RAD = 0.03e-3, float(np.radians(0.003))
"""1σ of the thermal motion of a sound cell, per axis; it does not count as a move."""
CAMERA, TAG, SHARED, MOVES = slice(0, 6), slice(6, 12), slice(16, 20), slice(0, 16)
"""Columns: camera pose X, tag pose P; tag size, focal length, cx, cy; moves: X, P, zeros of joints 2 to 5."""
_JOINT_RAD = float(np.radians(0.1))
_SIZE_SHARE, _FOCAL_SHARE, _CENTRE_PX = 0.005, 0.005, 3.0
UNITS = np.concatenate(
    [np.tile(np.repeat([DEAD_BAND_M, DEAD_BAND_RAD], 3), 2), np.full(4, _JOINT_RAD), np.ones(4)]
)
"""Unit of each column: the dead band, 0.1° of a joint, and the prior 1σ of size and lens."""
_CORNER_PX = 0.2
_REPEATS_M, _REPEATS_RAD = 0.05e-3, float(np.radians(0.004))
"""1σ of an arm's repeatability. The learning images scale all noise together."""
_TABLE_M, _TABLE_RAD = 0.2e-3, float(np.radians(0.02))
"""1σ of an arm's errors between postures."""
_LENS_PX, _LENS_REACH_PX = 0.08, 250.0
"""1σ of a lens model's residual errors, and their correlation length in the image."""


@dataclass(frozen=True, eq=False)
class Picture:
    """One production picture in which the tag was found."""

    name: str
    base_from_flange: Array
    """(4, 4)"""
    joints_rad: Array | None
    """(6,)"""
    corners: tuple[int, ...]
    """Rows of `boards.model.board_points` that are seen."""
    points: Array
    """(k, 3) of them on the tag, metres."""
    pixels: Array
    """(k, 2)"""


@dataclass(frozen=True, eq=False)
class CellModel:
    """Facts of a cell that are taken as known."""

    mount: Mount
    camera: CameraModel
    X: Array
    """(4, 4) flange_from_camera (eye-in-hand) or base_from_camera."""
    X_covariance: Array
    """(6, 6)"""
    arm: RobotModel | None = None
    """None: moves of joints are not considered."""


@dataclass(frozen=True)
class ArmErrors:
    """Sizes of an arm's errors, as factors on the usual ones."""

    repeating: float = 1.0
    table: float = 1.0


@dataclass(frozen=True, eq=False)
class Deviations:
    """Pictures whitened to unit noise."""

    y: Array
    """(n, 6)"""
    effects: Array
    """(n, 6, 20) derivative of y by each unknown, per its `UNITS`."""
    log_density: Array
    """(n,) ln of the determinant of the whitening."""

    def __len__(self) -> int:
        return len(self.y)


def deviations(
    cell: CellModel, P: Array, pictures: list[Picture], arm: ArmErrors
) -> tuple[Deviations, Deviations]:
    """Whiten pictures of equally many corners for the two tests: repeated postures, and any postures."""
    flange = np.array([picture.base_from_flange for picture in pictures])
    points = np.array([picture.points for picture in pictures])
    C = board_in_camera(cell.mount, flange, cell.X, P)
    turned = points @ np.swapaxes(C[:, :3, :3], 1, 2)
    projected = project(cell.camera, turned + C[:, None, :3, 3], with_intrinsics=True)
    r = np.array([picture.pixels for picture in pictures]) - projected.pixels
    n, k = r.shape[:2]
    L = np.concatenate([projected.by_point, projected.by_point @ -skew(turned)], axis=-1).reshape(n, 2 * k, 6)
    L_t = np.swapaxes(L, 1, 2)
    information = L_t @ L
    step = np.linalg.solve(information, L_t)
    by_X, by_P, by_flange = _effects_of_poses(cell, flange, P)
    assert projected.by_intrinsics is not None
    lens, K = projected.by_intrinsics.reshape(n, 2 * k, -1), camera_matrix(cell.camera)
    focal = lens[..., 0] * K[0, 0] + lens[..., 1] * K[1, 1]
    size = (projected.by_point @ turned[..., None])[..., 0].reshape(n, 2 * k)
    shared = np.stack(
        [size * _SIZE_SHARE, focal * _FOCAL_SHARE, lens[..., 2] * _CENTRE_PX, lens[..., 3] * _CENTRE_PX],
        axis=-1,
    )
    effects = np.concatenate(
        [by_X, by_P, _effects_of_joints(cell, pictures, by_flange), step @ shared], axis=-1
    )
    effects *= UNITS
    y = (step @ r.reshape(n, 2 * k, 1))[..., 0]
    noise = _CORNER_PX**2 * np.linalg.inv(information)
    again = noise + _carried(by_flange, arm.repeating * _REPEATS_M, arm.repeating * _REPEATS_RAD)
    alike = np.kron(_alike(projected.pixels), np.eye(2))
    anywhere = again + _carried(by_flange, arm.table * _TABLE_M, arm.table * _TABLE_RAD)
    anywhere += step @ alike @ np.swapaxes(step, 1, 2)
    return _whitened(y, effects, again), _whitened(y, effects, anywhere)


def _whitened(y: Array, effects: Array, covariance: Array) -> Deviations:
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    log_density = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return Deviations((root @ y[..., None])[..., 0], root @ effects, log_density)


def _carried(by_flange: Array, metres: float, radians: float) -> Array:
    variance = np.repeat([metres, radians], 3) ** 2
    return np.asarray((by_flange * variance) @ np.swapaxes(by_flange, 1, 2))


def _alike(pixels: Array) -> Array:
    """Compute the covariance (n, k, k) of the lens model's errors at corners (n, k, 2)."""
    apart = ((pixels[:, :, None] - pixels[:, None]) ** 2).sum(axis=-1)
    return np.asarray(_LENS_PX**2 * np.exp(-apart / (2 * _LENS_REACH_PX**2)))


def _effects_of_poses(cell: CellModel, flange: Array, P: Array) -> tuple[Array, Array, Array]:
    """Compute ∂C/∂X, ∂C/∂P and ∂C/∂F, (n, 6, 6): the tag's motion in the camera by deltas of each."""
    in_hand = cell.mount == "eye-in-hand"
    mount = inverse(flange) if in_hand else flange
    tag = transform_points(mount, P[:3, 3][None])[:, 0]
    R_camera = np.broadcast_to(cell.X[:3, :3].T, (len(flange), 3, 3))
    R_far = R_camera @ mount[:, :3, :3]
    if in_hand:
        by_flange = -_turned_about(R_far, P[:3, 3] - flange[:, :3, 3])
    else:
        by_flange = _turned_about(R_camera, tag - flange[:, :3, 3])
    by_X = -_turned_about(R_camera, tag - cell.X[:3, 3])
    return by_X, _turned_about(R_far, np.zeros_like(tag)), by_flange


def _turned_about(R: Array, lever: Array) -> Array:
    """Compute the motion (n, 6, 6), in the camera, of a point at `lever` (n, 3) in a frame that moves."""
    moved = np.zeros((len(R), 6, 6))
    moved[:, :3, :3] = moved[:, 3:, 3:] = R
    moved[:, :3, 3:] = -R @ skew(lever)
    return moved


def _effects_of_joints(cell: CellModel, pictures: list[Picture], by_flange: Array) -> Array:
    joints = [picture.joints_rad for picture in pictures]
    if cell.arm is None or any(q is None for q in joints):
        return np.zeros((len(pictures), 6, 4))
    return np.asarray(by_flange @ jacobian(cell.arm, np.array(joints))[..., 1:5])


def fitted_tag(cell: CellModel, pictures: list[Picture], starts: list[Array]) -> tuple[Array, float]:
    """Fit the tag's pose P (4, 4) to images, X taken as exact, from the best of several starts.

    Outliers are down-weighted (Huber). The second value is the images' median deviation, px.
    """
    P = min(starts, key=lambda start: _median_px(cell, start, pictures))
    for _ in range(_STEPS):
        whitened = all_deviations(cell, P, pictures, ArmErrors())[1]
        y, J = whitened.y, whitened.effects[..., TAG]
        length = np.linalg.norm(y, axis=1)
        weights = np.minimum(1.0, 1.5 * np.median(length) / np.maximum(length, 1e-12))
        N = np.einsum("n,nia,nib->ab", weights, J, J)
        step = np.linalg.solve(N + 1e-12 * np.trace(N) * np.eye(6), np.einsum("n,nia,ni->a", weights, J, y))
        P = perturb(P, step * UNITS[TAG])
    return P, _median_px(cell, P, pictures)


_STEPS = 8


def all_deviations(
    cell: CellModel, P: Array, pictures: list[Picture], arm: ArmErrors
) -> tuple[Deviations, Deviations]:
    """Whiten pictures of any corners; see `deviations`."""
    groups = [deviations(cell, P, group, arm) for group in same_corners(pictures)]
    again, anywhere = (
        Deviations(
            *(np.concatenate([getattr(w, name) for w in kind]) for name in ("y", "effects", "log_density"))
        )
        for kind in zip(*groups, strict=True)
    )
    return again, anywhere


def same_corners(pictures: list[Picture]) -> list[list[Picture]]:
    """Split into runs of pictures with equally many corners, in their order."""
    runs: list[list[Picture]] = []
    for picture in pictures:
        if not runs or len(runs[-1][0].pixels) != len(picture.pixels):
            runs.append([])
        runs[-1].append(picture)
    return runs


def _median_px(cell: CellModel, P: Array, pictures: list[Picture]) -> float:
    found = []
    for group in same_corners(pictures):
        C = board_in_camera(cell.mount, np.array([p.base_from_flange for p in group]), cell.X, P)
        seen = project(cell.camera, transform_points(C, np.array([p.points for p in group]))).pixels
        found.append(np.sqrt(np.mean((np.array([p.pixels for p in group]) - seen) ** 2, axis=(1, 2))))
    rms_px = np.concatenate(found)
    return float(np.median(np.where(np.isfinite(rms_px), rms_px, np.inf)))
