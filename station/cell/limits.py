"""Limits before motion: whole paths are checked and their speeds capped before anything moves.

A joint move is straight in joint space with all joints in step, as the controller's moveJ runs it; speed
and acceleration are those of the leading joint. The caps below are code: no configuration raises them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from calibrate.geometry import Array, difference
from calibrate.kinematics import JOINT_NAMES, forward
from station.cell.collision import SPACING_M, CellGeometry, Contact, margins, moving_points, surface_speeds
from station.cell.config import SLOWEST_RAD_S, SLOWEST_RAD_S2, SPEED_CAP_M_S, LimitsConfig
from station.cell.plan import Plan, PlannedPose

JOINT_SPEED_CAP_RAD_S = 1.05
JOINT_ACCELERATION_CAP_RAD_S2 = 1.4
_SPEED_RESERVE = 0.97
"""Between samples a point may be a little faster than at them."""
_TURN_RAD = 0.05
"""No joint turns further between two of them: surfaces are fast where centre lines hardly move."""
_PIECES = 48
"""A move is first looked at in so many, to find how dense its samples must be."""
_LONGEST_TURN_RAD = 4 * np.pi
"""From one end of a joint's range to the other; whatever turns further is out of range."""
_LEAVING_SLACK_M = 0.001
_FLANGE_TOLERANCE_M, _FLANGE_TOLERANCE_RAD = 0.002, 0.005


@dataclass(frozen=True)
class Problem:
    """One broken limit. `str()` is the sentence for people."""

    pose: str
    limit: str
    text: str
    joint: str = ""
    """The joint or body that breaks it."""
    what: str = ""
    """Clearance: which two things come too close."""

    def __str__(self) -> str:
        return f"{self.pose}: {self.text}"


@dataclass(frozen=True)
class MoveCheck:
    """One joint move, checked along its whole path."""

    name: str
    problems: tuple[Problem, ...]
    joint_speed_rad_s: float
    """Speed of the leading joint: with it no modelled point exceeds the speed limit."""
    joint_acceleration_rad_s2: float
    duration_s: float
    path_m: float
    """Length of the flange's path."""
    step_rad: float
    """Turn of the leading joint."""
    top_speed_m_s: float
    """Speed of the fastest modelled point, with the trapezoid's true peak."""
    margin_m: float
    """Smallest distance to any limit along the path."""


@dataclass(frozen=True)
class PlanCheck:
    moves: tuple[MoveCheck, ...]
    problems: tuple[Problem, ...]
    """All of them: of the moves, and of the plan as such."""

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
    """Duration (s) and peak speed (rad/s) of a move of the leading joint by `step_rad`, from rest to rest."""
    step, speed = np.abs(step_rad), np.asarray(speed_rad_s, dtype=float)
    peak = np.minimum(speed, np.sqrt(step * acceleration_rad_s2))
    cruise = np.maximum(step - peak**2 / acceleration_rad_s2, 0.0)
    return 2 * peak / acceleration_rad_s2 + cruise / np.maximum(peak, 1e-9), peak


def joint_bounds(geometry: CellGeometry) -> tuple[Array, Array]:
    """Lowest and highest joint angles (6,), rad: the arm's own and the configuration's."""
    own, limits = geometry.model.joint_limit_rad, geometry.limits
    low = np.maximum(-own, limits.joints_min_rad or (-own,) * 6)
    high = np.minimum(own, limits.joints_max_rad or (own,) * 6)
    return low, high


def point_speed_m_s(geometry: CellGeometry, joints_rad: ArrayLike, joint_speeds_rad_s: ArrayLike) -> float:
    """Speed of the fastest point on the surface of arm, tool or camera, now."""
    q, dq = np.asarray(joints_rad, dtype=float), np.asarray(joint_speeds_rad_s, dtype=float)
    return float(surface_speeds(geometry, q[None], dq).max())


def sample_path(geometry: CellGeometry, from_rad: Array, to_rad: Array, spacing_m: float) -> Array:
    """Joints (m, 6) along the move, so dense that no modelled point moves more than `spacing_m` between."""
    coarse = from_rad + np.linspace(0, 1, _PIECES + 1)[:, None] * (to_rad - from_rad)
    steps = np.linalg.norm(np.diff(moving_points(geometry, coarse), axis=0), axis=-1)
    # An arc is longer than its chord, and speed changes along it: 10 % covers both in a piece this short.
    count = int(np.ceil(1.1 * _PIECES * steps.max() / spacing_m)) + 1
    turns = int(np.ceil(np.abs(to_rad - from_rad).max() / _TURN_RAD)) + 1
    return np.asarray(from_rad + np.linspace(0, 1, max(count, turns, 3))[:, None] * (to_rad - from_rad))


def check_path(
    geometry: CellGeometry, from_joints_rad: ArrayLike, to_joints_rad: ArrayLike, name: str = "move"
) -> MoveCheck:
    """Everything that can be wrong with one move, and the speed it may be driven at."""
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
    if speed < SLOWEST_RAD_S or acceleration < SLOWEST_RAD_S2:
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
    """A move that is not worth sampling; speed zero."""
    return MoveCheck(name, tuple(problems), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -np.inf)


def allowed_speed(geometry: CellGeometry, samples: Array) -> tuple[float, float, float, float]:
    """Samples (m, 6) evenly along one move → leading joint's speed and acceleration, duration, top speed."""
    step_rad = float(np.abs(samples[-1] - samples[0]).max())
    turn = (samples[-1] - samples[0]) / max(step_rad, 1e-9)
    metres_per_rad = float(surface_speeds(geometry, samples, turn).max())
    speed, acceleration = leading_speed(geometry.limits, metres_per_rad)
    duration, peak = trapezoid(step_rad, speed, acceleration)
    return float(speed), acceleration, float(duration), float(peak * metres_per_rad)


def leading_speed(limits: LimitsConfig, metres_per_rad: ArrayLike) -> tuple[Array, float]:
    """Speed (rad/s) and acceleration (rad/s²) of moves whose fastest point goes so far per rad (n,)."""
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
    """Margins (..., samples, c) along paths, where an arm that already stands too close may move away.

    A margin that starts negative counts as zero for as long as it only grows, and grows fast enough to be
    gone at the end of the path: sliding along a wall is no retreat.
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
        ]  # a plate is several rods
        gap = gaps[:, alike].min(axis=1)
        at = int(np.argmin(gap))
        if gap[at] < 0:
            where = (
                "at the target" if at == len(gaps) - 1 else f"after {at / (len(gaps) - 1):.0%} of the path"
            )
            text = f"{contact}, {-1000 * gap[at]:.0f} mm too close {where}"
            problems.append(Problem(name, "clearance", text, contact.body, str(contact)))
    return problems


def check_plan(plan: Plan, start_joints_rad: ArrayLike | None, geometry: CellGeometry) -> PlanCheck:
    """The whole plan from where the arm is now (None: from its first pose), move by move."""
    problems = list(_plan_problems(plan, geometry))
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
    """The plan may ask for slower joints than the configuration, never for faster ones."""
    return slower(geometry, np.inf, plan.joint_speed_rad_s, plan.joint_acceleration_rad_s2)


def slower(
    geometry: CellGeometry,
    speed_m_s: float = np.inf,
    joint_speed_rad_s: float = np.inf,
    joint_acceleration_rad_s2: float = np.inf,
) -> CellGeometry:
    """The cell with speed limits that are no higher than these."""
    limits = geometry.limits
    lower = msgspec.structs.replace(
        limits,
        speed_m_s=min(limits.speed_m_s, speed_m_s),
        joint_speed_rad_s=min(limits.joint_speed_rad_s, joint_speed_rad_s),
        joint_acceleration_rad_s2=min(limits.joint_acceleration_rad_s2, joint_acceleration_rad_s2),
    )
    return replace(geometry, limits=lower)


def _plan_problems(plan: Plan, geometry: CellGeometry) -> list[Problem]:
    wrong = []
    if not plan.poses:
        wrong.append(("poses", "it has no poses"))
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
