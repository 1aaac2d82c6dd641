"""The arm as masses that torques move, for programs that command torques instead of positions.

Masses, centres of mass and largest torques: Universal Robots, "DH parameters for calculations of kinematics
and dynamics" and "Max. joint torques". Each link counts as a point. Universal Robots publishes neither the
rotors' inertia nor friction: both are assumed, of the size that MuJoCo Menagerie gives its UR10e.
The only module of the controller that needs NumPy: loaded where a controller takes torques.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from station.simulation.controller.kinematics import (
    ArmGeometry,
    Rigid,
    Vector,
    frames,
    place,
    read_table,
)

Array = NDArray[np.float64]

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
        self._frames = np.reshape(frames(table, joints_rad), (7, 3, 4))
        self._speeds = np.array(speeds_rad_s)
        self._axes, self._points = self._frames[:-1, :, 2], self._frames[:-1, :, 3]
        turns = np.cumsum(self._speeds[:, None] * self._axes, axis=0)
        self._axis_rates = np.cross(np.vstack([np.zeros(3), turns[:-1]]), self._axes)
        self._velocities = self._speeds @ self._columns(self._points, np.arange(6))

    def _columns(self, x: Array, links: NDArray[np.intp]) -> Array:
        """(n, 6, 3): how fast points (n, 3) of links move per speed of each joint before them."""
        return np.where(_before(links), np.cross(self._axes, x[:, None] - self._points), 0.0)

    def _column_rates(self, x: Array, links: NDArray[np.intp]) -> Array:
        v = self._speeds @ self._columns(x, links)
        rates = np.cross(self._axis_rates, x[:, None] - self._points)
        rates += np.cross(self._axes, v[:, None] - self._velocities)
        return np.where(_before(links), rates, 0.0)

    def _placed(self, bodies: Sequence[Body]) -> tuple[Array, Array, NDArray[np.intp]]:
        """Masses (n,), places (n, 3) in base, and links (n,)."""
        links, masses, places = (np.array(column) for column in zip(*bodies, strict=True))
        T = self._frames[links]
        return masses, np.einsum("nij,nj->ni", T[:, :, :3], places) + T[:, :, 3], links

    def mass_matrix(self, bodies: Sequence[Body]) -> Array:
        """(6, 6) [kg m²]"""
        masses, x, links = self._placed(bodies)
        columns = self._columns(x, links)
        return np.asarray(ROTOR_KG_M2 * np.eye(6) + np.einsum("n,nik,njk->ij", masses, columns, columns))

    def coriolis(self, bodies: Sequence[Body]) -> Array:
        """(6,) [Nm]"""
        masses, x, links = self._placed(bodies)
        accelerations = self._speeds @ self._column_rates(x, links)
        return np.asarray(np.einsum("n,njk,nk->j", masses, self._columns(x, links), accelerations))

    def accelerations(self, bodies: Sequence[Body], most_nm: Vector, torques_nm: Vector) -> Array:
        """(6,) [rad/s²] that torques give beside those against gravity; none is larger than most_nm."""
        most = np.array(most_nm)
        friction = FRICTION_S * most * self._speeds
        left = np.clip(torques_nm, -most, most) - self.coriolis(bodies) - friction
        return np.linalg.solve(self.mass_matrix(bodies), left)

    def jacobian(self, base_from_tool: Rigid) -> Array:
        """(6, 6): the tool's velocity [m/s] and rotation [rad/s] in base, per joint speed."""
        x, last = np.array([place(base_from_tool)]), np.array([6])
        return np.vstack([self._columns(x, last)[0].T, self._axes.T])

    def jacobian_rate(self, base_from_tool: Rigid) -> Array:
        x, last = np.array([place(base_from_tool)]), np.array([6])
        return np.vstack([self._column_rates(x, last)[0].T, self._axis_rates.T])


def _before(links: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(n, 6, 1): whether a joint moves a link."""
    return np.asarray((np.arange(6) < links[:, None])[..., None])
