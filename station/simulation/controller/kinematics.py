"""The simulated arm's own kinematics in plain scalars: fast enough for 500 Hz, and independent.

`calibrate.arms.kinematics` is deliberately not used: the station compares the controller's flange pose with
its own, and shared code would let a shared sign error cancel. A rigid transform here is a 12-tuple,
the rows of its upper 3×4 block. Standard Denavit-Hartenberg parameters as published by Universal Robots,
"DH parameters for calculations of kinematics and dynamics". Metres and radians. The table
of every model is in `arms.csv`.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from math import atan2, copysign, cos, pi, sin, sqrt
from operator import add
from pathlib import Path

Rigid = tuple[float, ...]
"""(12,) r00 r01 r02 tx r10 r11 r12 ty r20 r21 r22 tz"""
Vector = tuple[float, ...]
"""(6,) one number a joint, or (3,) x, y, z."""

IDENTITY: Rigid = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
JOINT_LIMIT_RAD = 2 * pi


@dataclass(frozen=True)
class ArmGeometry:
    a_m: Vector
    d_m: Vector
    alpha_rad: Vector = (pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0)
    theta_rad: Vector = (0.0,) * 6

    def plus(self, *differences: Vector) -> ArmGeometry:
        """differences: of a_m, d_m, alpha_rad and theta_rad."""
        if not any(map(any, differences)):
            return self
        columns = zip((self.a_m, self.d_m, self.alpha_rad, self.theta_rad), differences, strict=True)
        a, d, alpha, theta = (tuple(map(add, column, by)) for column, by in columns)
        return ArmGeometry(a, d, alpha, theta)


def read_table(name: str) -> list[dict[str, str]]:
    """Rows of a CSV file beside this module."""
    with Path(__file__).with_name(name).open(newline="") as stream:
        return list(csv.DictReader(stream))


def _geometry(a2_m: float, a3_m: float, d1_m: float, d4_m: float, d5_m: float, d6_m: float) -> ArmGeometry:
    return ArmGeometry((0.0, a2_m, a3_m, 0.0, 0.0, 0.0), (d1_m, 0.0, 0.0, d4_m, d5_m, d6_m))


TABLES = {
    row.pop("model"): _geometry(**{name: float(value) for name, value in row.items()})
    for row in read_table("arms.csv")
}


def between(first: Vector, second: Vector, share: float) -> Vector:
    return tuple(a + share * (b - a) for a, b in zip(first, second, strict=True))


def nudged(T: Rigid, by: Vector) -> Rigid:
    """Turned where it is by φ and moved by δt. by: (6,) δt [m], φ [rad], seen from where T maps to."""
    R = compose(from_rotvec(*by[3:]), T)
    return (*R[:3], T[3] + by[0], *R[4:7], T[7] + by[1], *R[8:11], T[11] + by[2])


def compose(A: Rigid, B: Rigid) -> Rigid:
    a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, a10, a11 = A
    b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11 = B
    return (
        a0 * b0 + a1 * b4 + a2 * b8,
        a0 * b1 + a1 * b5 + a2 * b9,
        a0 * b2 + a1 * b6 + a2 * b10,
        a0 * b3 + a1 * b7 + a2 * b11 + a3,
        a4 * b0 + a5 * b4 + a6 * b8,
        a4 * b1 + a5 * b5 + a6 * b9,
        a4 * b2 + a5 * b6 + a6 * b10,
        a4 * b3 + a5 * b7 + a6 * b11 + a7,
        a8 * b0 + a9 * b4 + a10 * b8,
        a8 * b1 + a9 * b5 + a10 * b9,
        a8 * b2 + a9 * b6 + a10 * b10,
        a8 * b3 + a9 * b7 + a10 * b11 + a11,
    )


def turn_between(A: Rigid, B: Rigid) -> Rigid:
    """The rotation from A's orientation to B's, seen from where both map to."""
    a0, a1, a2, _, a4, a5, a6, _, a8, a9, a10, _ = A
    return compose(B, (a0, a4, a8, 0.0, a1, a5, a9, 0.0, a2, a6, a10, 0.0))


def from_rotvec(rx: float, ry: float, rz: float, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Rigid:
    """Rotation vector [rad] and translation [m] (Rodrigues' formula)."""
    angle = sqrt(rx * rx + ry * ry + rz * rz)
    if angle < 1e-12:
        return (1.0, -rz, ry, x, rz, 1.0, -rx, y, -ry, rx, 1.0, z)
    u, v, w = rx / angle, ry / angle, rz / angle
    c, s = cos(angle), sin(angle)
    k = 1 - c
    return (
        c + u * u * k, u * v * k - w * s, u * w * k + v * s, x,
        v * u * k + w * s, c + v * v * k, v * w * k - u * s, y,
        w * u * k - v * s, w * v * k + u * s, c + w * w * k, z,
    )  # fmt: skip


def to_rotvec(A: Rigid) -> tuple[float, float, float]:
    """Rotation vector [rad], angle in [0, π], by way of the quaternion (accurate near 0 and near π)."""
    m00, m01, m02, _, m10, m11, m12, _, m20, m21, m22, _ = A
    multiples = (  # of the quaternion w, x, y, z: by 4 w, 4 x, 4 y and 4 z
        (1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01),
        (m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20),
        (m02 - m20, m01 + m10, 1 + m11 - m00 - m22, m12 + m21),
        (m10 - m01, m02 + m20, m12 + m21, 1 + m22 - m00 - m11),
    )
    w, x, y, z = multiples[max(range(4), key=lambda i: multiples[i][i])]
    norm = copysign(sqrt(x * x + y * y + z * z), w)
    scale = 2 / w if abs(norm) < 1e-12 else 2 * atan2(abs(norm), abs(w)) / norm
    return x * scale, y * scale, z * scale


def from_pose(pose: Vector) -> Rigid:
    """UR pose: x y z [m], rotation vector [rad]."""
    x, y, z, rx, ry, rz = pose
    return from_rotvec(rx, ry, rz, x, y, z)


def to_pose(A: Rigid) -> Vector:
    return (A[3], A[7], A[11], *to_rotvec(A))


def forward(table: ArmGeometry, joints_rad: Vector) -> Rigid:
    """base_from_flange."""
    found = IDENTITY
    for q, theta, a, d, alpha in zip(
        joints_rad, table.theta_rad, table.a_m, table.d_m, table.alpha_rad, strict=True
    ):
        ct, st, ca, sa = cos(q + theta), sin(q + theta), cos(alpha), sin(alpha)
        step = (ct, -st * ca, st * sa, a * ct, st, ct * ca, -ct * sa, a * st, 0.0, sa, ca, d)
        found = compose(found, step)
    return found
