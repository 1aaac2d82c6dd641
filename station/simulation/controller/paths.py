"""Paths of a motion over one parameter, and speed profiles along them.

A path's parameter `s` runs from 0 to `length`: the leading joint's angle [rad] for joint moves, the
distance [m] (or the angle [rad] of a pure rotation) for straight ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import hypot, sqrt

from station.simulation.controller.kinematics import (
    JOINT_LIMIT_RAD,
    ArmGeometry,
    Rigid,
    Vector,
    between,
    compose,
    forward,
    from_rotvec,
    inverse_nearest,
    invert,
    moved_to,
    plus,
    position,
    to_rotvec,
)


class UnreachableError(Exception):
    """The arm cannot go there: no inverse solution, or a joint beyond its limit."""


class JointPath:
    """Through given joints one after the other, all joints together, each in proportion to its own way."""

    def __init__(self, start: Vector, *goals: Vector) -> None:
        if any(not abs(q) <= JOINT_LIMIT_RAD for goal in goals for q in goal):
            raise UnreachableError(f"joints {goals} are outside ±2π")
        self._corners = (start, *goals)
        self._ends = [0.0]
        for first, second in pairwise(self._corners):
            step = max(abs(b - a) for a, b in zip(first, second, strict=True))
            self._ends.append(self._ends[-1] + step)
        self.length = self._ends[-1]

    def at(self, s: float) -> Vector:
        for i, end in enumerate(self._ends[1:]):
            if s < end:
                begin = self._ends[i]
                return between(self._corners[i], self._corners[i + 1], (s - begin) / (end - begin))
        return self._corners[-1]


class LinePath:
    """The tool's point on a straight line, the tool turning about one fixed axis; the nearest inverse."""

    def __init__(
        self, table: ArmGeometry, flange_from_tcp: Rigid, start: Vector, base_from_goal: Rigid
    ) -> None:
        self._table = table
        self._tcp_from_flange = invert(flange_from_tcp)
        self._first = compose(forward(table, start), flange_from_tcp)
        self._way = plus(position(base_from_goal), position(self._first), -1)
        x, y, z = to_rotvec(compose(invert(self._first), base_from_goal))
        self._turn = (x, y, z)
        distance, angle = hypot(*self._way), hypot(x, y, z)
        self.length = distance if distance > 1e-6 else angle
        self._joints = start
        goal = inverse_nearest(table, compose(base_from_goal, self._tcp_from_flange), start)
        if goal is None:
            raise UnreachableError(f"no joints reach {base_from_goal}")

    def at(self, s: float) -> Vector:
        u = min(s / self.length, 1.0) if self.length > 0 else 1.0
        x, y, z = self._turn
        turned = compose(self._first, from_rotvec(u * x, u * y, u * z))
        tcp = moved_to(turned, plus(position(self._first), self._way, u))
        joints = inverse_nearest(self._table, compose(tcp, self._tcp_from_flange), self._joints)
        if joints is None:
            raise UnreachableError("the straight line leaves the arm's reach")
        self._joints = joints
        return joints


Path = JointPath | LinePath
"""`at(s)` gives the joints, asked for in increasing order. Raises UnreachableError."""


@dataclass(frozen=True)
class Trapezoid:
    """Constant acceleration, constant speed, constant deceleration (or a triangle, when short).

    `at` gives (s, ds/dt) at a time from the start.
    """

    length: float
    speed: float
    acceleration: float

    @property
    def peak_speed(self) -> float:
        return min(self.speed, sqrt(self.length * self.acceleration))

    @property
    def duration_s(self) -> float:
        if self.length == 0:
            return 0.0
        return self.length / self.peak_speed + self.peak_speed / self.acceleration

    def at(self, t_s: float) -> tuple[float, float]:
        total, peak, a = self.duration_s, self.peak_speed, self.acceleration
        ramp_s = peak / a
        if t_s >= total:
            return self.length, 0.0
        if t_s < ramp_s:
            return a * t_s * t_s / 2, a * t_s
        if t_s < total - ramp_s:
            return peak * (t_s - ramp_s / 2), peak
        left = total - t_s
        return self.length - a * left * left / 2, a * left


@dataclass(frozen=True)
class Braking:
    """Constant deceleration from where the arm is to rest, on the same path."""

    start: float
    speed: float
    duration_s: float

    def at(self, t_s: float) -> tuple[float, float]:
        if self.duration_s <= 0:
            return self.start, 0.0
        t = min(t_s, self.duration_s)
        u = t / self.duration_s
        return self.start + self.speed * t * (1 - u / 2), self.speed * (1 - u)


Profile = Trapezoid | Braking
