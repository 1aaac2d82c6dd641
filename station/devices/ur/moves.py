"""Monitoring of one asynchronous move by the state stream: arrived, under way, or failed. Pure functions.

ur_rtde's script reports asynchronous operations in output_int_register_2: bits 24–30 count operations,
bit 15 = running. The word is written by another thread of the script, so a move that was just accepted may
still look "not running": only a new count means that it has begun. After a protective stop, a program stop
or a lost link the word freezes, so the state decides first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from recordings.schema.messages import RobotState
from station.cell.config import SLOWEST_RAD_S, SLOWEST_RAD_S2
from station.cell.errors import RobotError
from station.devices.news import MOVING_S
from station.devices.ur.condition import control_ended

ARRIVED_RAD = 0.01
"""Largest distance of a joint from its goal at which the move has arrived."""
STRAYED_RAD = 0.05
"""Deviation of a joint from the straight path above which the arm has left it: 65 mm at 1.3 m."""
PROGRESS_RAD, NO_PROGRESS_S = 5e-4, 3.0
"""A move ends as a fault where its joints' largest distance from the goal changed by no more than this for so
long."""
SLIDER_ZERO_S = 10.0
"""Longest wait for a speed slider at 0; the move then ends, lest the arm start unexpectedly."""
SLIDER_STILL = 0.005
"""Fraction of the speed, as the controller tells it, below which the slider counts as at 0."""
JOINT_SPEED_LIMIT_RAD_S = 1.05
JOINT_ACCELERATION_LIMIT_RAD_S2 = 1.5
STOP_RAD_S2 = 4.0
"""Deceleration of the joints at STOP. From full speed the arm rests after 0.26 s."""


def check_goal(
    joints_rad: Sequence[float], speed_rad_s: float, acceleration_rad_s2: float, limit_rad: float
) -> None:
    """Raise RobotError for an invalid goal: ur_rtde would send NaN and wrong lengths to the controller."""
    if len(joints_rad) != 6 or not all(math.isfinite(q) and abs(q) <= limit_rad for q in joints_rad):
        raise RobotError(
            "bad-goal", reason=f"not six joint angles within ± {limit_rad:.2f} rad: {joints_rad}"
        )
    if not SLOWEST_RAD_S <= speed_rad_s <= JOINT_SPEED_LIMIT_RAD_S:
        limits = f"{SLOWEST_RAD_S}…{JOINT_SPEED_LIMIT_RAD_S}"
        raise RobotError("bad-goal", reason=f"joint speed {speed_rad_s} rad/s (limits {limits})")
    if not SLOWEST_RAD_S2 <= acceleration_rad_s2 <= JOINT_ACCELERATION_LIMIT_RAD_S2:
        limits = f"{SLOWEST_RAD_S2}…{JOINT_ACCELERATION_LIMIT_RAD_S2}"
        raise RobotError("bad-goal", reason=f"acceleration {acceleration_rad_s2} rad/s² (limits {limits})")


def operation_count(word: int) -> int:
    return word >> 24 & 0x7F


def is_running(word: int) -> bool:
    return bool(word & 1 << 15)


def beside(
    start_rad: Sequence[float], target_rad: Sequence[float], joints_rad: Sequence[float]
) -> tuple[int, float]:
    """Find the joint furthest from the straight path, counted from 0, and its deviation (rad).

    The check of a path assumes that all joints move in step from start to target: straight in joint space.
    Compared with the point of that line nearest to the joints, but not beyond its ends.
    """
    way = [b - a for a, b in zip(start_rad, target_rad, strict=True)]
    gone = [q - a for a, q in zip(start_rad, joints_rad, strict=True)]
    length = sum(w * w for w in way)
    share = min(max(sum(g * w for g, w in zip(gone, way, strict=True)) / length, 0.0), 1.0) if length else 0.0
    off = [_or_infinite(abs(g - share * w)) for g, w in zip(gone, way, strict=True)]
    return off.index(max(off)), max(off)


def _or_infinite(value: float) -> float:
    """Count what is not finite as infinitely far: the largest of NaN and a number depends on their order."""
    return value if math.isfinite(value) else math.inf


@dataclass
class MoveWatch:
    start_rad: Sequence[float]
    """Joints (6,) when the move was requested."""
    target_rad: Sequence[float]
    operation_before: int
    """The status word before the move was requested."""
    begun_s: float
    notice: str = ""
    """Hint for people that is no fault, such as a low speed slider; empty: none."""
    _last_progress_s: float = field(init=False)
    _distance_rad: float = field(init=False, default=float("inf"))
    _ended_s: float | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._last_progress_s = self.begun_s

    def step(self, state: RobotState, word: int, now_s: float) -> bool:
        """Check a state; True when arrived. Raises RobotError where the move ended otherwise."""
        if (trouble := control_ended(state)) is not None:
            raise trouble
        joint, off_rad = beside(self.start_rad, self.target_rad, state.joints_rad)
        if not off_rad <= STRAYED_RAD:
            raise RobotError("off-path", joint=joint + 1, off_rad=off_rad, limit_rad=STRAYED_RAD)
        distances = [_or_infinite(abs(q - t)) for q, t in zip(state.joints_rad, self.target_rad, strict=True)]
        distance_rad = max(distances)
        if abs(distance_rad - self._distance_rad) > PROGRESS_RAD:
            self._distance_rad = distance_rad
            self._last_progress_s = now_s
        if operation_count(word) != operation_count(self.operation_before) and not is_running(word):
            return self._ended(distance_rad, distances.index(distance_rad), now_s)
        self._waiting(state, now_s)
        return False

    def _ended(self, distance_rad: float, joint: int, now_s: float) -> bool:
        if distance_rad <= ARRIVED_RAD:
            return True
        if self._ended_s is None:
            self._ended_s = now_s
        if now_s - self._ended_s > MOVING_S:
            raise RobotError("ended-short", joint=joint + 1, distance_rad=distance_rad, limit_rad=ARRIVED_RAD)
        return False

    def _waiting(self, state: RobotState, now_s: float) -> None:
        idle_s = now_s - self._last_progress_s
        fraction = state.target_speed_fraction
        self.notice = ""
        if fraction < SLIDER_STILL:
            self.notice = "the speed slider on the pendant is at 0: the arm waits for it"
            if idle_s > SLIDER_ZERO_S:
                raise RobotError("slider-zero", limit_s=SLIDER_ZERO_S)
            return
        if fraction < 0.995:
            self.notice = f"speed slider at {fraction * 100:.0f} %"
        if idle_s > NO_PROGRESS_S:
            raise RobotError("no-progress", limit_s=NO_PROGRESS_S)
