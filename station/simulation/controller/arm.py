"""The arm itself: follows one joint move at a time, lags a little, and can be made to misbehave."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import exp, sqrt

from station.simulation.controller.kinematics import JOINT_LIMIT_RAD, ArmGeometry, Vector, between

LAG_S = 0.015
"""Time constant with which the true joints follow the commanded ones."""
SCALE_PER_S = 5.0
"""Rate at which the speed scaling follows the slider or a pause."""
PROGRAM_END_RAD_S2 = 4.0
"""Deceleration when the program ends under a motion."""
ZERO: Vector = (0.0,) * 6
SPAN_S = 15.0


class UnreachableError(Exception):
    """The arm cannot go there: a joint would be beyond its limit."""


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


class JointMotion:
    """A straight move in joint space: all joints begin and end together. `done` once it rests at its end.

    Its parameter `s` is the leading joint's angle [rad], from 0.
    """

    def __init__(self, goal: Vector, speed: float, acceleration: float) -> None:
        """Raises UnreachableError."""
        if any(not abs(q) <= JOINT_LIMIT_RAD for q in goal):
            raise UnreachableError(f"joints {goal} are outside ±2π")
        self.goal = goal
        self.speed = speed
        self.acceleration = acceleration
        self.begin(goal)
        self.elapsed_s = 0.0
        self.braking = False
        self.done = False

    def begin(self, start: Vector) -> None:
        """Set out from these joints."""
        self._start = start
        self._length = max(abs(b - a) for a, b in zip(start, self.goal, strict=True))
        self.profile: Profile = Trapezoid(self._length, self.speed, self.acceleration)

    def at(self, s: float) -> Vector:
        return between(self._start, self.goal, s / self._length) if s < self._length else self.goal


class SimulatedArm:
    """Joints that move in time. Speeds in rad/s of simulated time; `scale` is slider × pause."""

    def __init__(self, table: ArmGeometry, joints_rad: Vector, draw_miss: Callable[[], Vector]) -> None:
        self.table = table
        self.command = joints_rad
        self.command_speed = ZERO
        self.actual = joints_rad
        self.actual_speed = ZERO
        self.scale = 1.0
        self.motion: JointMotion | None = None
        self._next: JointMotion | None = None
        self._draw_miss = draw_miss
        self.miss = draw_miss()
        """(6,) [δt (m), δφ (rad)] by which the true flange misses its pose now."""
        self._misses = (self.miss, self.miss)

    @property
    def moving(self) -> bool:
        return self.motion is not None

    def start(self, goal: Vector, speed: float, acceleration: float) -> JointMotion:
        """Goes there; from a running motion it comes to rest first. Raises UnreachableError."""
        motion = JointMotion(goal, speed, acceleration)
        if self.motion is None:
            self._begin(motion)
        else:
            self.brake(PROGRAM_END_RAD_S2)
            self._next = motion
        return motion

    def _begin(self, motion: JointMotion) -> None:
        motion.begin(self.command)
        self.motion = motion
        self._misses = (self.miss, self._draw_miss())

    def brake(self, deceleration_rad_s2: float) -> None:
        """Comes to rest on its path, the leading joint at this deceleration."""
        duration_s = max(map(abs, self.command_speed)) / deceleration_rad_s2
        self._drop_next()
        motion = self.motion
        if motion is None:
            return
        s, speed = motion.profile.at(motion.elapsed_s)
        speed *= self.scale
        if motion.braking and motion.profile.duration_s - motion.elapsed_s <= duration_s:
            return
        self._misses = (self.miss, self._misses[1])
        motion.profile = Braking(s, speed, duration_s)
        motion.braking = True
        motion.elapsed_s = 0.0

    def _drop_next(self) -> None:
        if self._next is not None:
            self._next.done = True
            self._next = None

    def freeze(self) -> None:
        """At rest at once, where it is: the brakes, or the safety system."""
        self._drop_next()
        if self.motion is not None:
            self.motion.done = True
            self.motion = None
        self.command = self.actual
        self.command_speed = self.actual_speed = ZERO

    def step(self, dt_s: float, wanted_scale: float) -> None:
        """One cycle."""
        change = SCALE_PER_S * dt_s
        self.scale += max(-change, min(change, wanted_scale - self.scale))
        if self.motion is not None:
            self._follow(self.motion, dt_s)
        elif self.command_speed is not ZERO:
            self.command_speed = ZERO
        self._lag(dt_s)

    def _follow(self, motion: JointMotion, dt_s: float) -> None:
        motion.elapsed_s += dt_s * (1.0 if motion.braking else self.scale)
        profile = motion.profile
        s, _ = profile.at(motion.elapsed_s)
        joints = motion.at(s)
        self.command_speed = tuple((b - a) / dt_s for a, b in zip(self.command, joints, strict=True))
        self.command = joints
        share = min(1.0, motion.elapsed_s / profile.duration_s) if profile.duration_s > 0 else 1.0
        self.miss = between(*self._misses, share)
        if motion.elapsed_s >= profile.duration_s:
            self._end(motion)

    def _end(self, motion: JointMotion) -> None:
        motion.done = True
        following = self._next
        self.motion = self._next = None
        if following is not None:
            self._begin(following)

    def _lag(self, dt_s: float) -> None:
        before, goal = self.actual, self.command
        if goal == before:
            self.actual_speed = ZERO
            return
        near = max(abs(g - a) for g, a in zip(goal, before, strict=True)) < 1e-9
        self.actual = goal if near else between(before, goal, 1 - exp(-dt_s / LAG_S))
        self.actual_speed = tuple((b - a) / dt_s for a, b in zip(before, self.actual, strict=True))


class History:
    """One sample per cycle, the newest; interpolated between cycles."""

    def __init__(self, dt_s: float) -> None:
        self._samples: deque[tuple[int, Vector, Vector]] = deque(maxlen=int(SPAN_S / dt_s))

    def add(self, monotonic_ns: int, joints: Vector, miss: Vector) -> None:
        self._samples.append((monotonic_ns, joints, miss))

    @property
    def newest_ns(self) -> int:
        return self._samples[-1][0] if self._samples else 0

    def at(self, monotonic_ns: int) -> tuple[Vector, Vector]:
        """Joints and miss at that time. LookupError when it is older than the samples or not yet reached."""
        if monotonic_ns <= self.newest_ns:
            t1, q1, m1 = self._samples[-1]
            for t0, q0, m0 in reversed(self._samples):  # what is asked for is seldom old
                if t0 <= monotonic_ns:
                    u = (monotonic_ns - t0) / (t1 - t0) if t1 > t0 else 0.0
                    return between(q0, q1, u), between(m0, m1, u)
                t1, q1, m1 = t0, q0, m0
        oldest_ns = self._samples[0][0] if self._samples else 0
        raise LookupError(f"time {monotonic_ns} is outside the history {oldest_ns}…{self.newest_ns} ns")
