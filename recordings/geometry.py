"""Rigid transforms with frame names, and the SO(3)/SE(3) maps that everything else is written in.

`base_from_flange` maps points of `flange` into `base`; chains touch:
``base_from_flange @ flange_from_camera @ camera_from_board``. Inside solvers plain arrays of shape
(..., 4, 4) are used under the same names; `Transform` stands wherever frames could be mixed up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[np.float64]
else:
    Array = np.ndarray  # `numpy.typing` takes longer to load than a calibration


class FrameMismatchError(ValueError):
    """Two transforms were chained whose frames do not touch."""


@dataclass(frozen=True, eq=False)
class Transform:
    """A rigid transform `parent_from_child`: maps points of `child` (metres) into `parent`."""

    parent: str
    child: str
    matrix: Array
    """(4, 4), rotation orthonormal to 1e-6; raises ValueError otherwise."""

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=float)
        if matrix.shape != (4, 4) or not is_rigid(matrix):
            raise ValueError(f"{self.parent}_from_{self.child} is not a rigid transform:\n{matrix}")
        matrix.flags.writeable = False
        object.__setattr__(self, "matrix", matrix)

    @property
    def rotation(self) -> Array:
        """(3, 3)"""
        return self.matrix[:3, :3]

    @property
    def translation_m(self) -> Array:
        """(3,)"""
        return self.matrix[:3, 3]

    @property
    def quaternion_xyzw(self) -> Array:
        """(4,), w >= 0"""
        return quaternion_from_matrix(self.rotation)

    def inverse(self) -> Transform:
        return Transform(self.child, self.parent, inverse(self.matrix))

    def __matmul__(self, other: Transform) -> Transform:
        if self.child != other.parent:
            raise FrameMismatchError(
                f"{self.parent}_from_{self.child} @ {other.parent}_from_{other.child}: "
                f"'{self.child}' does not touch '{other.parent}'"
            )
        return Transform(self.parent, other.child, self.matrix @ other.matrix)

    def apply(self, points: Array) -> Array:
        """Map points (..., 3) of `child`, metres, into `parent`."""
        return transform_points(self.matrix, points)


def pose(rotation: ArrayLike, translation_m: ArrayLike) -> Array:
    """Make poses (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    R, t = np.asarray(rotation, dtype=float), np.asarray(translation_m, dtype=float)
    matrix = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = R, t, 1.0
    return matrix


def inverse(matrix: Array) -> Array:
    """Invert rigid transforms (..., 4, 4)."""
    R_t = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return pose(R_t, -np.einsum("...ij,...j->...i", R_t, matrix[..., :3, 3]))


def transform_points(matrix: Array, points: Array) -> Array:
    """Apply rigid transforms (..., 4, 4) to points (..., n, 3) or (3,), metres."""
    points = np.asarray(points, dtype=float)
    if points.ndim == 1:
        return np.asarray(matrix[..., :3, :3] @ points + matrix[..., :3, 3])
    return np.asarray(points @ np.swapaxes(matrix[..., :3, :3], -1, -2) + matrix[..., None, :3, 3])


def is_rigid(matrix: Array, tolerance: float = 1e-6) -> bool:
    R = matrix[:3, :3]
    return bool(
        np.isfinite(matrix).all()
        and np.abs(R @ R.T - np.eye(3)).max() < tolerance
        and np.linalg.det(R) > 0
        and np.abs(matrix[3] - [0, 0, 0, 1]).max() < tolerance
    )


def skew(v: Array) -> Array:
    """Make [v]× (..., 3, 3) of vectors (..., 3): skew(v) @ w = v × w."""
    v = np.asarray(v, dtype=float)
    S = np.zeros((*v.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2] = -v[..., 2], v[..., 1]
    S[..., 1, 0], S[..., 1, 2] = v[..., 2], -v[..., 0]
    S[..., 2, 0], S[..., 2, 1] = -v[..., 1], v[..., 0]
    return S


def rotation_exp(vector: ArrayLike) -> Array:
    """Convert rotation vectors (..., 3), radians, to matrices (..., 3, 3) (Rodrigues)."""
    v = np.asarray(vector, dtype=float)
    angle = np.sqrt((v * v).sum(axis=-1))[..., None, None]
    a, b = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # sin x/x, (1 - cos x)/x²
    R = b * (v[..., :, None] * v[..., None, :]) + a * skew(v)
    R[..., [0, 1, 2], [0, 1, 2]] += np.cos(angle[..., 0])
    return np.asarray(R)


def rotation_log(R: ArrayLike) -> Array:
    """Convert rotation matrices (..., 3, 3) to rotation vectors (..., 3), radians, angle in [0, π].

    At exactly π the axis sign is ambiguous; either one is returned. What is not quite orthogonal is projected
    first; ValueError for what mirrors. (Written out: SciPy's takes two to three times as long.)
    """
    return rotvec_from_quaternion(quaternion_from_matrix(R))


def rotvec_from_quaternion(quaternion_xyzw: ArrayLike) -> Array:
    """Convert quaternions (..., 4) x, y, z, w of any positive norm to rotation vectors (..., 3), radians.

    The angle is in [0, π]: q and -q are the same rotation.
    """
    q = np.asarray(quaternion_xyzw, dtype=float)
    q = q * np.copysign(1.0, q[..., 3:])
    sine = np.sqrt((q[..., :3] ** 2).sum(axis=-1, keepdims=True))
    return np.asarray(q[..., :3] * (2 * np.arctan2(sine, q[..., 3:]) / np.maximum(sine, 1e-300)))


def _four_qq(M: Array) -> Array:
    """(..., 4, 4): 4 q qᵀ of the quaternion q = x, y, z, w of M (..., 3, 3); linear in M."""
    return np.asarray((M.reshape(-1, 9) @ _QQ_FROM_M + _QQ_AT_ZERO).reshape(*M.shape[:-2], 4, 4))


def _coefficients() -> Array:
    """(9, 16): 4 q qᵀ - 1 from a rotation matrix, both row by row."""
    found = np.zeros((9, 16))
    for row, signs in enumerate(((1, -1, -1, 1), (-1, 1, -1, 1), (-1, -1, 1, 1))):
        found[4 * row, ::5] = signs
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for place in (4 * i + j, 4 * j + i):  # 4 q_i q_j = M_ij + M_ji
            found[[3 * i + j, 3 * j + i], place] = 1.0
        for place in (4 * k + 3, 12 + k):  # 4 q_k w = M_ji - M_ij
            found[[3 * j + i, 3 * i + j], place] = 1.0, -1.0
    return found


_QQ_AT_ZERO, _QQ_FROM_M = np.eye(4).ravel(), _coefficients()


def _largest_row(four_qq: Array) -> Array:
    """q up to its sign from the row of its largest component (Shepperd), unit length."""
    rows = four_qq.reshape(-1, 4, 4)
    largest = rows.reshape(-1, 16)[:, ::5].argmax(axis=-1)
    q = rows[np.arange(len(rows)), largest]
    return np.asarray((q / np.sqrt((q * q).sum(axis=-1, keepdims=True))).reshape(four_qq.shape[:-1]))


def rotation_angle(R: ArrayLike) -> Any:
    """Measure the angle of rotation matrices (..., 3, 3), radians, accurate near 0 and near π."""
    return np.linalg.norm(rotation_log(R), axis=-1)


def project_to_rotation(M: Array) -> Array:
    """Find the nearest rotation (Frobenius) to matrices (..., 3, 3), by SVD with det = +1."""
    U, _, Vt = np.linalg.svd(M)
    D = np.zeros_like(M)
    D[..., 0, 0] = D[..., 1, 1] = 1.0
    D[..., 2, 2] = np.sign(np.linalg.det(U @ Vt))
    return np.asarray(U @ D @ Vt)


def quaternion_from_matrix(R: ArrayLike) -> Array:
    """Convert (..., 3, 3) to quaternions (..., 4) x, y, z, w with w >= 0.

    What is not quite orthogonal is projected first; ValueError for what mirrors.
    """
    M = np.asarray(R, dtype=float)
    four_qq = _four_qq(M)
    q = _largest_row(four_qq)
    if (np.abs(4 * q[..., :, None] * q[..., None, :] - four_qq) > 1e-12).any():  # some are no rotation
        if (np.linalg.det(M) <= 0).any():
            raise ValueError("a matrix of this stack is no rotation: its determinant is not positive")
        q = _largest_row(_four_qq(project_to_rotation(M)))
    return np.asarray(q * np.copysign(1.0, q[..., 3:]))


def matrix_from_quaternion(quaternion_xyzw: ArrayLike) -> Array:
    """Convert quaternions (..., 4) x, y, z, w (any positive norm) to (..., 3, 3).

    ValueError for a quaternion of zeros, or with a number that is not finite: it is no rotation.
    """
    q = np.asarray(quaternion_xyzw, dtype=float)
    length = np.linalg.norm(q, axis=-1)
    if not (np.isfinite(length) & (length > 0)).all():
        raise ValueError("a quaternion of zeros, or one that is not finite, is no rotation")
    return rotation_exp(rotvec_from_quaternion(q))


def pose_from_quaternion(translation_m: ArrayLike, quaternion_xyzw: ArrayLike) -> Array:
    return pose(matrix_from_quaternion(quaternion_xyzw), translation_m)


def pose_from_vector(vector: ArrayLike) -> Array:
    """Convert UR's six numbers (..., 6), x, y, z [m] and a rotation vector [rad], to (..., 4, 4)."""
    v = np.asarray(vector, dtype=float)
    return pose(rotation_exp(v[..., 3:]), v[..., :3])


def vector_from_pose(matrix: Array) -> Array:
    """Convert poses (..., 4, 4) to UR's six numbers (..., 6): x, y, z [m] and a rotation vector [rad]."""
    return np.concatenate([matrix[..., :3, 3], rotation_log(matrix[..., :3, :3])], axis=-1)


def base_from_flange(tcp_pose: ArrayLike, tcp_offset: ArrayLike) -> Array:
    """Take the tool off a controller's tool poses: base_from_flange (..., 4, 4).

    tcp_pose: base_from_tcp (..., 6), tcp_offset: flange_from_tcp (6,), each as UR's six numbers.
    """
    return np.asarray(pose_from_vector(tcp_pose) @ inverse(pose_from_vector(tcp_offset)))


def perturb(matrix: Array, delta: ArrayLike) -> Array:
    """Apply the one error convention: delta = (..., 6) [δt (m), δφ (rad)], both in the parent frame.

    R = Exp(δφ) R̂, t = t̂ + δt. The 6×6 covariances everywhere are of this delta, in this order.
    """
    d = np.asarray(delta, dtype=float)
    return pose(rotation_exp(d[..., 3:]) @ matrix[..., :3, :3], matrix[..., :3, 3] + d[..., :3])


def difference(matrix: Array, reference: Array) -> Array:
    """Compute the delta (..., 6) with perturb(reference, delta) = matrix."""
    d_phi = rotation_log(matrix[..., :3, :3] @ np.swapaxes(reference[..., :3, :3], -1, -2))
    return np.concatenate([matrix[..., :3, 3] - reference[..., :3, 3], d_phi], axis=-1)


def interpolate(first: Array, second: Array, fraction: float) -> Array:
    """Interpolate poses (4, 4): linear translation, constant-axis rotation."""
    R1 = first[:3, :3]
    R = R1 @ rotation_exp(fraction * rotation_log(R1.T @ second[:3, :3]))
    return pose(R, (1 - fraction) * first[:3, 3] + fraction * second[:3, 3])


def left_jacobian(v: Array) -> Any:
    """Compute the (..., 3, 3) of Exp(v + δ) ≈ Exp(J δ) Exp(v) for rotation vectors (..., 3)."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    small, S = angle < 1e-4, skew(v)
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + first * S + second * (S @ S)


def inverse_left_jacobian(v: Array) -> Any:
    """Compute ∂Log(Exp(δ) Exp(v))/∂δ at 0, (..., 3) → (..., 3, 3)."""
    half = np.maximum(np.linalg.norm(v, axis=-1)[..., None, None] / 2, 1e-6)
    c = np.where(half < 5e-5, 1 / 12, (1 - half / np.tan(half)) / (4 * half * half))
    S = skew(v)
    return np.eye(3) - S / 2 + c * (S @ S)


def rotation_from_rpy(angles: ArrayLike) -> Any:
    """Convert roll, pitch, yaw (3,) about fixed axes, radians, to R (3, 3) = Rz Ry Rx, as URDF does."""
    x, y, z = rotation_exp(np.diag(np.asarray(angles, float)))
    return z @ y @ x


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Convert R (3, 3) to roll, pitch, yaw about fixed axes, radians: the inverse of `rotation_from_rpy`.

    Yaw is computed after the roll, Rz(yaw) Ry(pitch) = R Rx(roll)ᵀ. So the three stay accurate together near
    a pitch of 90°, where SciPy's lose half the digits and where a camera that looks along the flange is.
    """
    roll = np.arctan2(R[2, 1], R[2, 2])
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    across = R[:, 1] * np.cos(roll) - R[:, 2] * np.sin(roll)
    yaw = np.arctan2(-across[0], across[1])
    return float(roll), float(pitch), float(yaw)
