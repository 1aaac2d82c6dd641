"""Paths of a motion over one parameter, and speed profiles along them.

A path's parameter `s` runs from 0 to `length`: the leading joint's angle [rad] for joint moves, the
distance [m] (or the angle [rad] of a pure rotation) for straight ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import atan2, cos, pi, sin, sqrt
from typing import Protocol

from station.simulation.controller.kinematics import (
    JOINT_LIMIT_RAD,
    ArmGeometry,
    Rigid,
    Six,
    compose,
    forward,
    from_rotvec,
    inverse_nearest,
    invert,
    to_rotvec,
)


class UnreachableError(Exception):
    """The arm cannot go there: no inverse solution, or a joint beyond its limit."""


class Path(Protocol):
    @property
    def length(self) -> float: ...

    def at(self, s: float) -> Six:
        """Joints at s. Asked for in increasing order. Raises UnreachableError."""


class JointPath:
    """All joints together, each in proportion to its own way."""

    def __init__(self, start: Six, goal: Six) -> None:
        if any(not abs(q) <= JOINT_LIMIT_RAD for q in goal):
            raise UnreachableError(f"joints {goal} are outside ±2π")
        self._start = start
        self._goal = goal
        self.length = max(abs(g - s) for s, g in zip(start, goal, strict=True))

    def at(self, s: float) -> Six:
        if s >= self.length:
            return self._goal
        u = s / self.length
        return tuple(a + u * (b - a) for a, b in zip(self._start, self._goal, strict=True))


class LinePath:
    """The tool's point on a straight line, the tool turning about one fixed axis; the nearest inverse."""

    def __init__(self, table: ArmGeometry, flange_from_tcp: Rigid, start: Six, base_from_goal: Rigid) -> None:
        self._table = table
        self._tcp_from_flange = invert(flange_from_tcp)
        self._first = compose(forward(table, start), flange_from_tcp)
        self._way = tuple(base_from_goal[i] - self._first[i] for i in (3, 7, 11))
        x, y, z = to_rotvec(compose(invert(self._first), base_from_goal))
        self._turn = (x, y, z)
        distance, angle = sqrt(sum(w * w for w in self._way)), sqrt(x * x + y * y + z * z)
        self.length = distance if distance > 1e-6 else angle
        self._joints = start
        goal = inverse_nearest(table, compose(base_from_goal, self._tcp_from_flange), start)
        if goal is None:
            raise UnreachableError(f"no joints reach {base_from_goal}")

    def _place(self, u: float) -> Six:
        """The tool's point at this share of the way."""
        return tuple(self._first[i] + u * w for i, w in zip((3, 7, 11), self._way, strict=True))

    def at(self, s: float) -> Six:
        u = min(s / self.length, 1.0) if self.length > 0 else 1.0
        x, y, z = self._turn
        turned = compose(self._first, from_rotvec(u * x, u * y, u * z))
        px, py, pz = self._place(u)
        tcp = (*turned[:3], px, *turned[4:7], py, *turned[8:11], pz)
        joints = inverse_nearest(self._table, compose(tcp, self._tcp_from_flange), self._joints)
        if joints is None:
            raise UnreachableError("the straight line leaves the arm's reach")
        self._joints = joints
        return joints


class ArcPath(LinePath):
    """The tool's point on a circle through a second point, the tool turning as on a line."""

    def __init__(
        self,
        table: ArmGeometry,
        flange_from_tcp: Rigid,
        start: Six,
        base_from_via: Rigid,
        base_from_goal: Rigid,
    ) -> None:
        super().__init__(table, flange_from_tcp, start, base_from_goal)
        begin, via, end = (
            tuple(T[i] for i in (3, 7, 11)) for T in (self._first, base_from_via, base_from_goal)
        )
        a, b = _minus(via, begin), _minus(end, begin)
        normal = _cross(a, b)
        area2 = _dot(normal, normal)
        if area2 < 1e-12:
            raise UnreachableError("three points on a line make no arc")
        # the circumcentre of a triangle, seen from its first corner
        away = _cross(tuple(_dot(a, a) * y - _dot(b, b) * x for x, y in zip(a, b, strict=True)), normal)
        self._centre = tuple(p + w / (2 * area2) for p, w in zip(begin, away, strict=True))
        self._u = _minus(begin, self._centre)
        self._v = tuple(x / sqrt(area2) for x in _cross(normal, self._u))
        last = _minus(end, self._centre)
        self._angle = atan2(_dot(last, self._v), _dot(last, self._u)) % (2 * pi)
        self.length = sqrt(_dot(self._u, self._u)) * self._angle

    def _place(self, u: float) -> Six:
        c, s = cos(u * self._angle), sin(u * self._angle)
        return tuple(m + c * x + s * y for m, x, y in zip(self._centre, self._u, self._v, strict=True))


def _minus(a: Six, b: Six) -> Six:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def _dot(a: Six, b: Six) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _cross(a: Six, b: Six) -> Six:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


class PolylinePath:
    """Through given joints one after the other at one pace: an arm led by hand."""

    def __init__(self, corners: list[Six]) -> None:
        self._corners = corners
        self._ends = [0.0]
        for first, second in pairwise(corners):
            step = max(abs(b - a) for a, b in zip(first, second, strict=True))
            self._ends.append(self._ends[-1] + step)
        self.length = self._ends[-1]

    def at(self, s: float) -> Six:
        for i in range(1, len(self._ends)):
            if s < self._ends[i]:
                u = (s - self._ends[i - 1]) / (self._ends[i] - self._ends[i - 1])
                first, second = self._corners[i - 1], self._corners[i]
                return tuple(a + u * (b - a) for a, b in zip(first, second, strict=True))
        return self._corners[-1]


class Profile(Protocol):
    @property
    def duration_s(self) -> float: ...

    def at(self, t_s: float) -> tuple[float, float]:
        """(s, ds/dt) at a time from the start."""


@dataclass(frozen=True)
class Trapezoid:
    """Constant acceleration, constant speed, constant deceleration (or a triangle, when short)."""

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
