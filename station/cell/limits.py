"""Checks before motion: clearance and limits along whole paths, and the speed allowed on them.

A joint move is straight in joint space with all joints in step, as the controller's moveJ does it. Speed and
acceleration are those of the leading joint, the one that turns furthest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from calibrate.arms.kinematics import JOINT_NAMES, forward
from recordings.geometry import Array, difference
from station.cell.collision import SPACING_M, CellGeometry, Contact, margins, moving_points, surface_speeds
from station.cell.config import SLOWEST_RAD_S, SLOWEST_RAD_S2, SPEED_CAP_M_S, LimitsConfig
from station.cell.pose_plan import Plan, PlannedPose

JOINT_SPEED_CAP_RAD_S = 1.05
JOINT_ACCELERATION_CAP_RAD_S2 = 1.4
_SPEED_RESERVE = 0.97
"""Factor on speeds, because between samples a point may be a little faster than at them."""
_TURN_RAD = 0.05
"""Largest turn of a joint between two samples: surfaces may move although centre lines hardly do."""
_PIECES = 48
"""Pieces into which a move is first divided to find the sampling that it needs."""
_LONGEST_TURN_RAD = 4 * np.pi
"""Largest turn of a joint: from one end of its range to the other."""
_LEAVING_SLACK_M = 0.001
_FLANGE_TOLERANCE_M, _FLANGE_TOLERANCE_RAD = 0.002, 0.005


@dataclass(frozen=True)
class Problem:
    """Violated limit. `str()` is the sentence for people."""

    pose: str
    limit: str
    text: str
    of: str = ""
    """What violates it: a joint, or which two things come too close."""

    def __str__(self) -> str:
        return f"{self.pose}: {self.text}"


@dataclass(frozen=True)
class MoveCheck:
    """Result of checking a joint move along its whole path."""

    name: str
    problems: tuple[Problem, ...]
    joint_speed_rad_s: float
    """Speed of the leading joint with which no modelled point exceeds the speed limit."""
    joint_acceleration_rad_s2: float
    duration_s: float
    path_m: float
    """Length of the flange's path."""
    step_rad: float
    """Turn of the leading joint."""
    top_speed_m_s: float
    """Speed of the fastest modelled point, at the peak that the move really reaches."""
    margin_m: float
    """Smallest distance to any limit along the path."""


@dataclass(frozen=True)
class PlanCheck:
    moves: tuple[MoveCheck, ...]
    problems: tuple[Problem, ...]
    """Violated limits of all moves, and of the plan itself."""

    @property
    def duration_s(self) -> float:
        return sum(move.duration_s for move in self.moves)

    @property
    def path_m(self) -> float:
        return sum(move.path_m for move in self.moves)

    @property
    def largest_step_rad(self) -> float:
        return max((move.step_rad for move in self.moves), default=0.0)

    @property
    def top_speed_m_s(self) -> float:
        return max((move.top_speed_m_s for move in self.moves), default=0.0)


def trapezoid(step_rad: ArrayLike, speed_rad_s: ArrayLike, acceleration_rad_s2: float) -> tuple[Array, Array]:
    """Compute duration (s) and peak speed (rad/s) of a turn by `step_rad` with a trapezoidal speed."""
    step, speed = np.abs(step_rad), np.asarray(speed_rad_s, dtype=float)
    peak = np.minimum(speed, np.sqrt(step * acceleration_rad_s2))
    cruise = np.maximum(step - peak**2 / acceleration_rad_s2, 0.0)
    return 2 * peak / acceleration_rad_s2 + cruise / np.maximum(peak, 1e-9), peak


def joint_bounds(geometry: CellGeometry) -> tuple[Array, Array]:
    """Return the lowest and highest joint angles (6,), rad, by the arm and the configuration."""
    own, limits = geometry.model.joint_limit_rad, geometry.limits
    low = np.maximum(-own, limits.joints_min_rad or (-own,) * 6)
    high = np.minimum(own, limits.joints_max_rad or (own,) * 6)
    return low, high


def point_speed_m_s(geometry: CellGeometry, joints_rad: ArrayLike, joint_speeds_rad_s: ArrayLike) -> float:
    """Compute the speed of the fastest surface point of arm, tool and camera, for joints (6,)."""
    q, dq = np.asarray(joints_rad, dtype=float), np.asarray(joint_speeds_rad_s, dtype=float)
    return float(surface_speeds(geometry, q[None], dq).max())


def sample_path(geometry: CellGeometry, from_rad: Array, to_rad: Array, spacing_m: float) -> Array:
    """Sample joints (m, 6) along a move so that no modelled point moves over `spacing_m` in between."""
    coarse = from_rad + np.linspace(0, 1, _PIECES + 1)[:, None] * (to_rad - from_rad)
    steps = np.linalg.norm(np.diff(moving_points(geometry, coarse), axis=0), axis=-1)
    # 10 % more, as arcs are longer than their chords and the speed changes within a piece.
    count = int(np.ceil(1.1 * _PIECES * steps.max() / spacing_m)) + 1
    turns = int(np.ceil(np.abs(to_rad - from_rad).max() / _TURN_RAD)) + 1
    return np.asarray(from_rad + np.linspace(0, 1, max(count, turns, 3))[:, None] * (to_rad - from_rad))


def check_path(
    geometry: CellGeometry, from_joints_rad: ArrayLike, to_joints_rad: ArrayLike, name: str = "move"
) -> MoveCheck:
    """Check one move from joints (6,) to joints (6,), rad, and find its allowed speed."""
    start, target = (np.asarray(q, dtype=float) for q in (from_joints_rad, to_joints_rad))
    if start.shape != (6,) or target.shape != (6,) or not np.isfinite([start, target]).all():
        return _refused(name, [Problem(name, "joints", "six finite joint angles in radians are needed")])
    problems = _joint_problems(geometry, start, target, name)
    if np.abs(target - start).max() > _LONGEST_TURN_RAD:
        return _refused(name, problems)
    samples = sample_path(geometry, start, target, SPACING_M)
    gaps, contacts = margins(geometry, samples)
    problems += _margin_problems(leaving(gaps - SPACING_M / 2), contacts, name)
    speed, acceleration, duration, peak = allowed_speed(geometry, samples)
    if not (speed >= SLOWEST_RAD_S and acceleration >= SLOWEST_RAD_S2):
        text = (
            f"its joints would go {speed:.2g} rad/s, at {acceleration:.2g} rad/s² (at least "
            f"{SLOWEST_RAD_S:g} rad/s, {SLOWEST_RAD_S2:g} rad/s²). Raise the speed limits"
        )
        problems.append(Problem(name, "speed", text))
    flange = forward(geometry.model, samples)[:, :3, 3]
    return MoveCheck(
        name=name,
        problems=tuple(problems),
        joint_speed_rad_s=speed,
        joint_acceleration_rad_s2=acceleration,
        duration_s=duration,
        path_m=float(np.linalg.norm(np.diff(flange, axis=0), axis=1).sum()),
        step_rad=float(np.abs(target - start).max()),
        top_speed_m_s=peak,
        margin_m=float(gaps.min()),
    )


def _refused(name: str, problems: list[Problem]) -> MoveCheck:
    """Make the result of a move that is refused without sampling; speed 0."""
    return MoveCheck(name, tuple(problems), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -np.inf)


def allowed_speed(geometry: CellGeometry, samples: Array) -> tuple[float, float, float, float]:
    """Compute leading joint's speed and acceleration, duration and top speed of a move.

    samples: joints (m, 6) evenly along it.
    """
    step_rad = float(np.abs(samples[-1] - samples[0]).max())
    turn = (samples[-1] - samples[0]) / max(step_rad, 1e-9)
    metres_per_rad = float(surface_speeds(geometry, samples, turn).max())
    speed, acceleration = leading_speed(geometry.limits, metres_per_rad)
    duration, peak = trapezoid(step_rad, speed, acceleration)
    return float(speed), acceleration, float(duration), float(peak * metres_per_rad)


def leading_speed(limits: LimitsConfig, metres_per_rad: ArrayLike) -> tuple[Array, float]:
    """Compute allowed speed (n,), rad/s, and acceleration, rad/s², of the leading joint.

    metres_per_rad: (n,) way of the fastest point per turn of the leading joint.
    """
    most_m_s = _SPEED_RESERVE * min(limits.speed_m_s, SPEED_CAP_M_S)
    by_points = most_m_s / np.maximum(metres_per_rad, 1e-9)
    speed = np.minimum(by_points, min(limits.joint_speed_rad_s, JOINT_SPEED_CAP_RAD_S))
    return speed, min(limits.joint_acceleration_rad_s2, JOINT_ACCELERATION_CAP_RAD_S2)


def _joint_problems(geometry: CellGeometry, start: Array, target: Array, name: str) -> list[Problem]:
    low, high = joint_bounds(geometry)
    problems = []
    for i, joint in enumerate(JOINT_NAMES):
        if not low[i] - 1e-9 <= target[i] <= high[i] + 1e-9:
            text = (
                f"{joint} would stand at {np.rad2deg(target[i]):.1f}° "
                f"(limit {np.rad2deg(low[i]):.0f}° to {np.rad2deg(high[i]):.0f}°)"
            )
            problems.append(Problem(name, "joint range", text, joint))
        turn, step = abs(target[i] - start[i]), geometry.limits.joint_step_rad
        if turn > step + 1e-9:
            text = (
                f"{joint} would turn {np.rad2deg(turn):.0f}° in one move (limit {np.rad2deg(step):.0f}°, "
                "limits.joint_step_rad). Add a pose in between or choose the same arm branch"
            )
            problems.append(Problem(name, "joint step", text, joint))
    return problems


def leaving(gaps: Array) -> Array:
    """Adjust margins (..., samples, c) along paths so that an arm that stands too close may move away.

    A margin that starts negative counts as zero while it only grows, and grows fast enough to be positive at
    the end of the path: sliding along a wall is not allowed.
    """
    growing = np.diff(gaps, axis=-2, prepend=gaps[..., :1, :]) > -1e-4
    left = 1.0 - np.linspace(0.0, 1.0, gaps.shape[-2])[:, None]
    fast = gaps >= gaps[..., :1, :] * left - _LEAVING_SLACK_M
    excused = np.cumprod(growing & fast & (gaps < 0), axis=-2).astype(bool)
    excused[..., -1, :] = False
    return np.where(excused, 0.0, gaps)


def _margin_problems(gaps: Array, contacts: Sequence[Contact], name: str) -> list[Problem]:
    problems = []
    for contact in dict.fromkeys(contacts):
        alike = [
            column for column, other in enumerate(contacts) if other == contact
        ]  # a plate consists of several capsules
        gap = gaps[:, alike].min(axis=1)
        at = int(np.argmin(gap))
        if not gap[at] >= 0:  # nor is what could not be computed free
            where = (
                "at the target" if at == len(gaps) - 1 else f"after {at / (len(gaps) - 1):.0%} of the path"
            )
            text = f"{contact}, {-1000 * gap[at]:.0f} mm too close {where}"
            problems.append(Problem(name, "clearance", text, str(contact)))
    return problems


def check_plan(plan: Plan, start_joints_rad: ArrayLike | None, geometry: CellGeometry) -> PlanCheck:
    """Check a plan move by move, from joints (6,) where the arm is; None: from its first pose."""
    problems = list(_plan_problems(plan, geometry))
    if any(problem.limit == "joints" for problem in problems):
        return PlanCheck((), tuple(problems))
    if not any(problem.limit == "speed" for problem in problems):
        geometry = with_plan_speeds(geometry, plan)
    before = start_joints_rad
    moves = []
    for number, pose in enumerate(plan.poses, start=1):
        name = f"pose {number} ({pose.name})"
        problems += _flange_problems(geometry, pose, name)
        origin = pose.joints_rad if before is None else before
        moves.append(check_path(geometry, origin, pose.joints_rad, name))
        before = pose.joints_rad
    return PlanCheck(tuple(moves), (*problems, *(p for move in moves for p in move.problems)))


def with_plan_speeds(geometry: CellGeometry, plan: Plan) -> CellGeometry:
    """Return the geometry with a plan's speed limits where these are lower than the configured ones."""
    return slower(
        geometry,
        joint_speed_rad_s=plan.joint_speed_rad_s,
        joint_acceleration_rad_s2=plan.joint_acceleration_rad_s2,
    )


def slower(geometry: CellGeometry, **most: float) -> CellGeometry:
    """Return the geometry with limits, by their names, that are at most these."""
    limits = geometry.limits
    lower = {name: min(getattr(limits, name), value) for name, value in most.items()}
    return replace(geometry, limits=msgspec.structs.replace(limits, **lower))


def _plan_problems(plan: Plan, geometry: CellGeometry) -> list[Problem]:
    wrong = []
    if not plan.poses:
        wrong.append(("poses", "it has no poses"))
    if any(len(pose.joints_rad) != 6 for pose in plan.poses):
        wrong.append(("joints", "its poses must have six joint angles each"))
    if not (plan.joint_speed_rad_s >= SLOWEST_RAD_S and plan.joint_acceleration_rad_s2 >= SLOWEST_RAD_S2):
        least = f"{SLOWEST_RAD_S:g} rad/s and {SLOWEST_RAD_S2:g} rad/s²"
        wrong.append(("speed", f"its joint speed and acceleration must be at least {least}"))
    if plan.robot != geometry.model.name:
        wrong.append(
            ("robot", f"made for a {plan.robot}, the cell has a {geometry.model.name}. Make a new plan")
        )
    if geometry.mount not in (None, plan.mount):
        wrong.append(("mount", f"made for {plan.mount}, the cell is {geometry.mount}. Make a new plan"))
    return [Problem("plan", limit, text) for limit, text in wrong]


def _flange_problems(geometry: CellGeometry, pose: PlannedPose, name: str) -> list[Problem]:
    if pose.base_from_flange is None or len(pose.joints_rad) != 6:
        return []
    delta = difference(forward(geometry.model, pose.joints_rad), np.array(pose.base_from_flange))
    off_m, off_rad = float(np.linalg.norm(delta[:3])), float(np.linalg.norm(delta[3:]))
    if off_m <= _FLANGE_TOLERANCE_M and off_rad <= _FLANGE_TOLERANCE_RAD:
        return []
    text = (
        f"joints and expected flange pose differ by {1000 * off_m:.1f} mm and {np.rad2deg(off_rad):.2f}°. "
        "Make a new plan for this arm model, or delete base_from_flange"
    )
    return [Problem(name, "flange pose", text)]
