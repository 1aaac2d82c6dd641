"""The arm itself: follows one motion at a time, lags a little, and can be made to misbehave."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import dist, exp, inf, pi

from station.simulation.controller.kinematics import (
    JOINT_LIMIT_RAD,
    ArmGeometry,
    Rigid,
    Vector,
    between,
    compose,
    forward,
    position,
)
from station.simulation.controller.paths import (
    Braking,
    JointPath,
    Path,
    Profile,
    Trapezoid,
    UnreachableError,
)

LAG_S = 0.015
"""Time constant with which the true joints follow the commanded ones."""
SCALE_PER_S = 5.0
"""Rate at which the speed scaling follows the slider or a pause."""
PROGRAM_END_RAD_S2 = 4.0
"""Deceleration when the program ends under a motion."""
ZERO: Vector = (0.0,) * 6

JOINT_SPEED_RAD_S = pi
"""No joint goes faster, whatever a script asks for."""

MakePath = Callable[[Vector], Path]
"""Joints where the motion begins → its path."""
Speeds = Callable[[Vector, float], Vector]
"""Commanded joints and the cycle's length [s] → the joint speeds wanted now. Raises UnreachableError."""
SPAN_S = 15.0


class JointMotion:
    """One way from here to there. `done` once the arm's command rests at its end."""

    def __init__(self, make_path: MakePath, speed: float, acceleration: float) -> None:
        self.make_path = make_path
        self.speed = speed
        self.acceleration = acceleration
        self.path: Path | None = None
        self.profile: Profile | None = None
        self.elapsed_s = 0.0
        self.braking = False
        self.done = False


class Stream(JointMotion):
    """A motion without an end, whose speeds are asked for in every cycle: servoj, speedj and their kin."""

    def __init__(self, wanted: Speeds, acceleration: float, speeds: Vector) -> None:
        super().__init__(JointPath, 0.0, acceleration)
        self.wanted = wanted
        self.speeds = speeds

    def step(self, joints: Vector, dt_s: float, scale: float) -> Vector:
        """The next joints: all speeds change together, the leading one by at most the acceleration."""
        wanted = ZERO if self.braking else self.wanted(joints, dt_s)
        fastest = max(map(abs, wanted))
        if fastest > JOINT_SPEED_RAD_S:
            wanted = tuple(v * JOINT_SPEED_RAD_S / fastest for v in wanted)
        change = max(abs(w - v) for w, v in zip(wanted, self.speeds, strict=True))
        share = 1.0 if change <= self.acceleration * dt_s else self.acceleration * dt_s / change
        self.speeds = between(self.speeds, wanted, share)
        moved = tuple(q + v * dt_s * scale for q, v in zip(joints, self.speeds, strict=True))
        if any(abs(q) > JOINT_LIMIT_RAD for q in moved):
            raise UnreachableError("a joint reaches its limit")
        return moved


class SimulatedArm:
    """Joints that move in time. Speeds in rad/s of simulated time; `scale` is slider × pause."""

    def __init__(self, table: ArmGeometry, joints_rad: Vector, draw_miss: Callable[[], Vector]) -> None:
        self.table = table
        self.flange_from_tcp: Rigid = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
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

    def start(self, make_path: MakePath, speed: float, acceleration: float) -> JointMotion:
        """Goes there; from a running motion it comes to rest first. Raises UnreachableError."""
        motion = JointMotion(make_path, speed, acceleration)
        if self.motion is None:
            self._begin(motion)
        else:
            make_path(self.command)  # an impossible goal is refused now, not after the braking
            self.brake(PROGRAM_END_RAD_S2)
            self._next = motion
        return motion

    def _begin(self, motion: JointMotion) -> None:
        motion.path = motion.make_path(self.command)
        motion.profile = Trapezoid(motion.path.length, motion.speed, motion.acceleration)
        self.motion = motion
        self._misses = (self.miss, self._draw_miss())

    @property
    def streams(self) -> bool:
        return isinstance(self.motion, Stream) and not self.motion.braking

    @property
    def stream_speeds(self) -> Vector:
        """Joint speeds a stream goes on from: those of the running one, before the slider scales them."""
        return self.motion.speeds if self.streams else self.command_speed  # type: ignore[union-attr]

    def stream(self, wanted: Speeds, acceleration: float) -> JointMotion:
        """Goes on from where and how fast the arm is now; a running motion ends here."""
        self._drop_next()
        stream = Stream(wanted, acceleration, self.stream_speeds)
        if self.motion is not None:
            self.motion.done = True
        self.motion = stream
        return stream

    def brake(self, deceleration_rad_s2: float) -> None:
        """Comes to rest on its path, the leading joint at this deceleration."""
        self._brake_in(max(map(abs, self.command_speed)) / deceleration_rad_s2)

    def brake_tool(self, deceleration_m_s2: float) -> None:
        """Comes to rest on its path, the tool's point at this deceleration (a pure turn: the joints)."""
        speed_m_s = self.tool_speed_m_s()
        if speed_m_s < 1e-4:
            self.brake(deceleration_m_s2)
        else:
            self._brake_in(speed_m_s / deceleration_m_s2)

    def tool_speed_m_s(self) -> float:
        step_s = 1e-4
        later = tuple(q + step_s * v for q, v in zip(self.command, self.command_speed, strict=True))
        here = compose(forward(self.table, self.command), self.flange_from_tcp)
        there = compose(forward(self.table, later), self.flange_from_tcp)
        return dist(position(here), position(there)) / step_s

    def _brake_in(self, duration_s: float) -> None:
        self._drop_next()
        motion = self.motion
        if isinstance(motion, Stream):
            if not motion.braking:
                motion.speeds = tuple(v * self.scale for v in motion.speeds)
                motion.acceleration = 0.0
            slower = max(map(abs, motion.speeds)) / duration_s if duration_s > 0 else inf
            motion.acceleration, motion.braking = max(slower, motion.acceleration), True
            return
        if motion is None or motion.profile is None:
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
        """One cycle. Raises UnreachableError when the path leaves the arm's reach (the arm then rests)."""
        change = SCALE_PER_S * dt_s
        self.scale += max(-change, min(change, wanted_scale - self.scale))
        if self.motion is not None:
            self._follow(self.motion, dt_s)
        elif self.command_speed is not ZERO:
            self.command_speed = ZERO
        self._lag(dt_s)

    def _follow(self, motion: JointMotion, dt_s: float) -> None:
        if isinstance(motion, Stream):
            self._flow(motion, dt_s)
            return
        assert motion.path is not None and motion.profile is not None
        motion.elapsed_s += dt_s * (1.0 if motion.braking else self.scale)
        profile = motion.profile
        s, _ = profile.at(motion.elapsed_s)
        try:
            joints = motion.path.at(s)
        except UnreachableError:
            self.freeze()
            raise
        self.command_speed = tuple((b - a) / dt_s for a, b in zip(self.command, joints, strict=True))
        self.command = joints
        share = min(1.0, motion.elapsed_s / profile.duration_s) if profile.duration_s > 0 else 1.0
        self.miss = between(*self._misses, share)
        if motion.elapsed_s >= profile.duration_s:
            self._end(motion)

    def _flow(self, motion: Stream, dt_s: float) -> None:
        try:
            joints = motion.step(self.command, dt_s, 1.0 if motion.braking else self.scale)
        except UnreachableError:
            self.freeze()
            raise
        self.command_speed = tuple((b - a) / dt_s for a, b in zip(self.command, joints, strict=True))
        self.command = joints
        if motion.braking and not any(motion.speeds):
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
