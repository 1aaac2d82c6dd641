"""The arm as masses that torques move, for programs that command torques instead of positions.

Masses, centres of mass and largest torques: Universal Robots, "DH parameters for calculations of kinematics
and dynamics" and "Max. joint torques". Each link counts as a point. Universal Robots publishes neither the
rotors' inertia nor friction: both are assumed, of the size that MuJoCo Menagerie gives its UR10e.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

from station.simulation.controller.kinematics import (
    ArmGeometry,
    Rigid,
    Vector,
    cross,
    dot,
    frames,
    place,
    plus,
    read_table,
)

Matrix = list[list[float]]

ROTOR_KG_M2 = 0.1
"""Each joint's rotor, as its link feels it."""
FRICTION_S = 0.03
"""Viscous friction at 1 rad/s, as a share of the joint's largest torque. There is no other friction."""


class Body(NamedTuple):
    link: int
    """1…6: behind which joint."""
    mass_kg: float
    place_m: Vector
    """In the frame of its link."""


class Drives(NamedTuple):
    bodies: tuple[Body, ...]
    most_nm: Vector
    """No joint gives more torque."""


def _drives(rows: list[dict[str, str]]) -> Drives:
    def body(row: dict[str, str]) -> Body:
        x, y, z = (float(row[axis]) for axis in ("x_m", "y_m", "z_m"))
        return Body(int(row["link"]), float(row["mass_kg"]), (x, y, z))

    return Drives(tuple(map(body, rows)), tuple(float(row["most_nm"]) for row in rows))


DRIVES = {model: _drives(list(rows)) for model, rows in groupby(read_table("links.csv"), itemgetter("model"))}
"""Masses of the arms whose controllers take torques."""


class Posture:
    """Joints, and how fast they turn: what moves how, in base. M q̈ + C + friction = torques beside gravity's.

    The columns of a point's Jacobian are z × (x − p) of every joint before it (z: the joint's axis, p: a
    point on it), so M is the sum of m JᵀJ over the bodies, and C that of m Jᵀ J̇ q̇.
    """

    def __init__(self, table: ArmGeometry, joints_rad: Vector, speeds_rad_s: Vector) -> None:
        self._frames = frames(table, joints_rad)
        self._speeds = speeds_rad_s
        self._axes: list[Vector] = [(T[2], T[6], T[10]) for T in self._frames[:-1]]
        self._points: list[Vector] = [place(T) for T in self._frames[:-1]]
        self._velocities = [self._velocity(p, j) for j, p in enumerate(self._points)]
        turns: list[Vector] = [(0.0, 0.0, 0.0)]
        for axis, speed in zip(self._axes, speeds_rad_s, strict=True):
            turns.append(plus(turns[-1], axis, speed))
        self._axis_rates = [cross(turn, axis) for turn, axis in zip(turns, self._axes, strict=False)]

    def _columns(self, x: Vector, link: int) -> list[Vector]:
        """Compute how fast a point of a link moves per speed of each joint before it."""
        pairs = zip(self._axes[:link], self._points, strict=False)
        return [cross(z, plus(x, p, -1)) for z, p in pairs]

    def _velocity(self, x: Vector, link: int) -> Vector:
        return _combined(self._columns(x, link), self._speeds)

    def _column_rates(self, x: Vector, link: int) -> list[Vector]:
        v = self._velocity(x, link)
        return [
            plus(
                cross(self._axis_rates[j], plus(x, self._points[j], -1)),
                cross(self._axes[j], plus(v, self._velocities[j], -1)),
            )
            for j in range(link)
        ]

    def _placed(self, body: Body) -> Vector:
        T, (x, y, z) = self._frames[body.link], body.place_m
        return (
            T[0] * x + T[1] * y + T[2] * z + T[3],
            T[4] * x + T[5] * y + T[6] * z + T[7],
            T[8] * x + T[9] * y + T[10] * z + T[11],
        )

    def mass_matrix(self, bodies: Sequence[Body]) -> Matrix:
        """(6, 6) [kg m²]"""
        M = [[ROTOR_KG_M2 * (i == j) for j in range(6)] for i in range(6)]
        for body in bodies:
            columns = self._columns(self._placed(body), body.link)
            for i, a in enumerate(columns):
                for j, b in enumerate(columns):
                    M[i][j] += body.mass_kg * dot(a, b)
        return M

    def coriolis(self, bodies: Sequence[Body]) -> list[float]:
        """(6,) [Nm]"""
        torques = [0.0] * 6
        for body in bodies:
            x = self._placed(body)
            acceleration = _combined(self._column_rates(x, body.link), self._speeds)
            for j, column in enumerate(self._columns(x, body.link)):
                torques[j] += body.mass_kg * dot(column, acceleration)
        return torques

    def accelerations(self, bodies: Sequence[Body], most_nm: Vector, torques_nm: Vector) -> list[float]:
        """(6,) [rad/s²] that torques give beside those against gravity; none is larger than most_nm."""
        left = [
            max(-most, min(most, torque)) - c - FRICTION_S * most * speed
            for torque, most, c, speed in zip(
                torques_nm, most_nm, self.coriolis(bodies), self._speeds, strict=True
            )
        ]
        return solved(self.mass_matrix(bodies), left)

    def jacobian(self, base_from_tool: Rigid) -> Matrix:
        """(6, 6): the tool's velocity [m/s] and rotation [rad/s] in base, per joint speed."""
        return _rows(self._columns(place(base_from_tool), 6), self._axes)

    def jacobian_rate(self, base_from_tool: Rigid) -> Matrix:
        return _rows(self._column_rates(place(base_from_tool), 6), self._axis_rates)


def solved(M: Matrix, right: Sequence[float]) -> list[float]:
    """x of M x = right, M positive definite: Gauss's elimination needs no pivoting."""
    rows = [[*row, value] for row, value in zip(M, right, strict=True)]
    count = len(rows)
    for i, row in enumerate(rows):
        for other in rows[i + 1 :]:
            share = other[i] / row[i]
            for j in range(i, count + 1):
                other[j] -= share * row[j]
    found = [0.0] * count
    for i in reversed(range(count)):
        known = sum(rows[i][j] * found[j] for j in range(i + 1, count))
        found[i] = (rows[i][count] - known) / rows[i][i]
    return found


def _rows(linear: Sequence[Vector], angular: Sequence[Vector]) -> Matrix:
    return [list(row) for columns in (linear, angular) for row in zip(*columns, strict=True)]


def _combined(vectors: Sequence[Vector], shares: Sequence[float]) -> Vector:
    total: Vector = (0.0, 0.0, 0.0)
    for vector, share in zip(vectors, shares, strict=False):
        total = plus(total, vector, share)
    return total
