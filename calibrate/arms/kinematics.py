"""Kinematics of Universal Robots arms: forward, all analytic inverses, Jacobian, singularity measure.

Standard Denavit-Hartenberg: frame i from i-1 is Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i), and after it, for axes
that are nearly parallel, Ry(beta_i) (S. Hayati, 1983; nominally 0). Frame 6 is the flange; `base` is the
controller's base frame. Lengths in metres, angles in radians. Parameters: Universal Robots, "DH parameters
for calculations of kinematics and dynamics". Needs NumPy only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recordings.geometry import Array, rotation_exp

_ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
JOINT_NAMES = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")
URDF_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
URDF_ORIGIN = ("x", "y", "z", "roll", "pitch", "yaw")
"""Keys of the kinematics file of ROS 2's UR driver."""


COLUMNS = ("a_m", "d_m", "alpha_rad", "theta_rad", "beta_rad")
Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class DhTable:
    """A kinematic table, joint 1 first: frame i from i-1 is Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""

    a_m: Six
    d_m: Six
    alpha_rad: Six
    theta_rad: Six
    beta_rad: Six

    @classmethod
    def of(cls, model: DhTable) -> DhTable:
        """Take the table alone of an arm's model."""
        return DhTable(*(getattr(model, name) for name in COLUMNS))


@dataclass(frozen=True)
class RobotModel(DhTable):
    """Kinematic table and limits of a UR arm."""

    alpha_rad: Six = _ALPHA
    theta_rad: Six = (0.0,) * 6
    beta_rad: Six = (0.0,) * 6
    name: str = ""
    joint_limit_rad: float = 2 * np.pi
    """Joints turn within ± this."""
    link_radius_m: tuple[float, ...] = field(default=(0.09, 0.075, 0.06, 0.05, 0.05, 0.045))
    """Rough capsule radii of the links, for clearance; generous."""

    def calibrated(self, *columns: Sequence[float], **named: Sequence[float]) -> RobotModel:
        """Add factory or estimated corrections (6,) to `COLUMNS`, in their order or by name.

        The analytic inverse stays the nominal table's.
        """
        corrections = dict(zip(COLUMNS, columns, strict=False)) | named
        changed: dict[str, Any] = {
            name: tuple(n + d for n, d in zip(getattr(self, name), delta, strict=True))
            for name, delta in corrections.items()
        }
        return replace(self, **changed)


def _model(name: str, a2: float, a3: float, d1: float, d4: float, d5: float, d6: float) -> RobotModel:
    return RobotModel((0.0, a2, a3, 0.0, 0.0, 0.0), (d1, 0.0, 0.0, d4, d5, d6), name=name)


MODELS: dict[str, RobotModel] = {
    m.name: m
    for m in (
        _model("UR3", -0.24365, -0.21325, 0.1519, 0.11235, 0.08535, 0.0819),
        _model("UR5", -0.425, -0.39225, 0.089159, 0.10915, 0.09465, 0.0823),
        _model("UR10", -0.612, -0.5723, 0.1273, 0.163941, 0.1157, 0.0922),
        _model("UR3e", -0.24355, -0.2132, 0.15185, 0.13105, 0.08535, 0.0921),
        _model("UR5e", -0.425, -0.3922, 0.1625, 0.1333, 0.0997, 0.0996),
        _model("UR10e", -0.6127, -0.57155, 0.1807, 0.17415, 0.11985, 0.11655),
        _model("UR16e", -0.4784, -0.36, 0.1807, 0.17415, 0.11985, 0.11655),
    )
}


def link_frames(model: DhTable, joints_rad: ArrayLike) -> Array:
    """Compute base_from_link (..., 7, 4, 4) of joints (..., 6); link 0 is the base, 6 the flange."""
    q = np.asarray(joints_rad, dtype=float)
    frames = np.zeros((*q.shape[:-1], 7, 4, 4))
    frames[..., 0, :, :] = np.eye(4)
    for i in range(6):
        theta = q[..., i] + model.theta_rad[i]
        ct, st = np.cos(theta), np.sin(theta)
        ca, sa = np.cos(model.alpha_rad[i]), np.sin(model.alpha_rad[i])
        step = np.zeros((*q.shape[:-1], 4, 4))
        step[..., 0, 0], step[..., 0, 1], step[..., 0, 2] = ct, -st * ca, st * sa
        step[..., 1, 0], step[..., 1, 1], step[..., 1, 2] = st, ct * ca, -ct * sa
        step[..., 2, 1], step[..., 2, 2] = sa, ca
        step[..., 0, 3], step[..., 1, 3], step[..., 2, 3] = model.a_m[i] * ct, model.a_m[i] * st, model.d_m[i]
        step[..., 3, 3] = 1.0
        if model.beta_rad[i]:
            cb, sb = np.cos(model.beta_rad[i]), np.sin(model.beta_rad[i])
            x, z = step[..., 0].copy(), step[..., 2].copy()
            step[..., 0], step[..., 2] = cb * x - sb * z, sb * x + cb * z
        frames[..., i + 1, :, :] = frames[..., i, :, :] @ step
    return frames


def with_near_axes(model: RobotModel) -> RobotModel:
    """Restate a table whose d2 and d3 are far off, so that no frame lies far from the arm: they become 0.

    A factory calibration states the common normal of two axes that are parallel to within a milliradian: it
    lies metres away, and theta turns with it. Here the normal is replaced by a turn beta. Same flange.
    """
    if not any(model.d_m[1:3]):
        return model
    frames = link_frames(model, np.zeros(6))
    return table_of_axes(model, frames[:6, :3, 2], frames[:6, :3, 3], frames[6])


_PARALLEL = (1, 2)
"""Joints, from 0, whose next axis is parallel to their own."""


def table_of_axes(like: RobotModel, direction: Array, point: Array, flange: Array) -> RobotModel:
    """Describe an arm by its axes with all joints at 0: d2 and d3 are 0, the parallel axes have a beta.

    direction, point: (6, 3) of each axis in base; flange: base_from_flange (4, 4). Axis 1 is base's z; what
    is behind joint 6, signs and name are as in `like`. ValueError where they are not so.
    """
    columns = np.zeros((5, 6))
    before = np.eye(4)
    for i in range(5):
        R, t = before[:3, :3], before[:3, 3]
        axis, at = R.T @ direction[i + 1], R.T @ (point[i + 1] - t)
        sign = -1.0 if (like.a_m[i] if i in _PARALLEL else like.alpha_rad[i]) < 0 else 1.0
        if i in _PARALLEL:
            at = at - at[2] / axis[2] * axis  # where the next axis passes the plane of this joint
            d, towards = 0.0, sign * at
            a = sign * np.hypot(at[0], at[1])
        else:
            towards = sign * np.array([-axis[1], axis[0], 0.0])  # common normal
            towards /= np.linalg.norm(towards)
            a = at @ towards
            across = at - a * towards  # its part along the next axis and z
            d = across[2] - axis[2] * (across[:2] @ axis[:2]) / (axis[:2] @ axis[:2])
        theta = np.arctan2(towards[1], towards[0])
        turned = rotation_exp([0.0, 0.0, theta]).T @ axis
        beta = np.arcsin(turned[0]) if i in _PARALLEL else 0.0
        alpha = np.arctan2(-turned[1], turned[2])
        columns[:, i] = a, d, alpha, theta, beta
        step = link_frames(_with_columns(like, columns), np.zeros(6))
        before = step[i + 1]
    columns[[0, 2, 4], 5] = like.a_m[5], like.alpha_rad[5], like.beta_rad[5]
    behind = link_frames(_with_columns(like, columns), np.zeros(6))
    last = np.linalg.inv(before) @ flange @ np.linalg.inv(np.linalg.inv(behind[5]) @ behind[6])
    if max(np.abs(last[:2, 3]).max(), np.abs(last[:2, 2]).max()) > _ON_AXIS:
        raise ValueError("the flange does not lie on the last axis")
    if max(np.abs(point[0, :2]).max(), np.abs(direction[0, :2]).max()) > _ON_AXIS:
        raise ValueError("the first axis is not the z axis of base")
    columns[1, 5], columns[3, 5] = last[2, 3], np.arctan2(last[1, 0], last[0, 0])
    return _with_columns(like, columns)


_ON_AXIS = 1e-6
"""Metres and radians by which a file's rounding may be off."""


def _with_columns(like: RobotModel, columns: Array) -> RobotModel:
    changed: dict[str, Any] = dict(zip(COLUMNS, map(tuple, columns.tolist()), strict=True))
    return replace(like, **changed)


def forward(model: RobotModel, joints_rad: ArrayLike) -> Array:
    """Compute base_from_flange (..., 4, 4) of joints (..., 6)."""
    return np.asarray(link_frames(model, joints_rad)[..., 6, :, :])


def jacobian(model: RobotModel, joints_rad: ArrayLike) -> Array:
    """Compute the geometric Jacobian (..., 6, 6) in base: flange velocity (m/s), angular velocity (rad/s)."""
    frames = link_frames(model, joints_rad)
    z = frames[..., :6, :3, 2]
    lever = frames[..., 6, None, :3, 3] - frames[..., :6, :3, 3]
    return np.concatenate([np.swapaxes(np.cross(z, lever), -1, -2), np.swapaxes(z, -1, -2)], axis=-2)


def singularity_measure(model: RobotModel, joints_rad: ArrayLike) -> Array:
    """Compute the Jacobian's smallest singular value (...), lengths over the arm's reach; 0 = singular."""
    J = jacobian(model, joints_rad).copy()
    J[..., :3, :] /= abs(model.a_m[1]) + abs(model.a_m[2])
    return np.asarray(np.linalg.svd(J, compute_uv=False)[..., -1])


def inverse_many(
    model: RobotModel, base_from_flange: Array
) -> tuple[NDArray[np.intp], Array, NDArray[np.intp]]:
    """Solve many poses (n, 4, 4): the pose of each solution (m,), joints (m, 6), branch (m,).

    Branches 0 … 7 are those of shoulder, wrist and elbow, each joint in (-π, π]. At a wrist singularity
    (sin q5 = 0) there are infinitely many solutions: only those with wrist 3 = 0 are given, and there may be
    none near the limit of the reach.

    Source: K. Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms" (2013).
    """
    a2, a3 = model.a_m[1], model.a_m[2]
    d1, _, _, d4, d5, d6 = model.d_m
    T = np.asarray(base_from_flange, dtype=float)
    wrist = T[:, :3, 3] - d6 * T[:, :3, 2]
    radius = np.hypot(wrist[:, 0], wrist[:, 1])
    reachable = np.flatnonzero(radius >= abs(d4))
    T, wrist, radius = T[reachable], wrist[reachable], radius[reachable]
    # Branches: shoulder side, wrist flip, elbow; each array is (poses, 2, 2, 2) or spreads to it.
    s1, s5, s3 = (np.array([1.0, -1.0]).reshape(shape) for shape in ((2, 1, 1), (2, 1), (2,)))
    one = (slice(None), None, None, None)
    q1 = np.arctan2(wrist[:, 1], wrist[:, 0])[one] + s1 * np.arccos(d4 / radius)[one] + np.pi / 2
    # Sideways axis of the arm in the flange: (sin q5 cos q6, -sin q5 sin q6, cos q5). Its two small
    # entries keep full precision near the wrist singularity, where arccos(cos q5) has none.
    side = [T[:, 0, i][one] * np.sin(q1) - T[:, 1, i][one] * np.cos(q1) for i in range(3)]
    sin_q5 = s5 * np.hypot(side[0], side[1])
    q5 = np.arctan2(sin_q5, side[2])
    straight = np.abs(sin_q5) <= 1e-9
    safe = np.where(straight, 1.0, sin_q5)
    q6 = np.where(straight, 0.0, np.arctan2(-side[1] / safe, side[0] / safe))
    x, y, tilt = _in_arm_plane(T[one], q1, q5, q6, d1, d5, d6)
    # Shoulder, elbow and wrist 1: a planar two-link arm, elbow up and down.
    c3 = (x * x + y * y - a2 * a2 - a3 * a3) / (2 * a2 * a3)
    q3 = s3 * np.arccos(np.clip(c3, -1, 1))
    q2 = np.arctan2(y, x) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
    joints = np.stack(np.broadcast_arrays(q1, q2, q3, tilt - q2 - q3, q5, q6), axis=-1).reshape(-1, 6)
    possible = np.flatnonzero(np.broadcast_to(np.abs(c3) <= 1 + 1e-9, q2.shape))
    return reachable[possible // 8], (joints[possible] + np.pi) % (2 * np.pi) - np.pi, possible % 8


def _in_arm_plane(
    T: Array, q1: Array, q5: Array, q6: Array, d1: float, d5: float, d6: float
) -> tuple[Array, Array, Array]:
    """Place wrist 1 in the plane of upper arm and forearm: x, y (m) and q2 + q3 + q4 (rad)."""
    c1, n1 = np.cos(q1), np.sin(q1)
    c5, n5, c6, n6 = np.cos(q5), np.sin(q5), np.cos(q6), np.sin(q6)
    # Origin and x axis of frame 4, in the flange and then in base.
    origin = (d5 * n6, d5 * c6, -d6)
    x_axis = (c5 * c6, -c5 * n6, -n5)
    in_base = [[sum(T[..., row, i] * v[i] for i in range(3)) for row in range(3)] for v in (origin, x_axis)]
    p = [in_base[0][row] + T[..., row, 3] for row in range(3)]
    x = c1 * p[0] + n1 * p[1]
    y = p[2] - d1
    tilt = np.arctan2(in_base[1][2], c1 * in_base[1][0] + n1 * in_base[1][1])
    return np.asarray(x), np.asarray(y), np.asarray(tilt)
