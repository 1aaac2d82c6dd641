"""Flange pose that puts the pointer over a corner of the board, and the path there.

A check of a calibration that needs no mathematics to believe: the tip stands where the calibration says the
corner is, a safe way above it; a person guides it down by hand and sees how far off it is. The station itself
never brings anything nearer to the board than 50 mm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrate.boards.model import board_points, outer_corners
from calibrate.files.calibration import Calibration
from calibrate.geometry import Array, difference, pose, rotation_exp, transform_points
from calibrate.kinematics import RobotModel, forward, inverse_all, jacobian, turned_near
from calibrate.quality.board_now import found_points, locate_board, offset_covariance
from calibrate.views import BoardView
from recordings.schema.messages import Vector6
from station.cell.collision import CellGeometry, margins, plate
from station.cell.config import Capsule, PointerConfig, StationConfig, vector3
from station.cell.errors import LimitError
from station.cell.limits import PlanCheck, check_plan, slower
from station.cell.plan import Plan
from station.cell.scene import board_extent, geometry_of, pose_at

CLEARANCE_M = 0.05
"""Nothing that moves comes nearer to the board, on the path or at the end."""
SPEED_M_S = 0.05
APPROACH_M = 0.15
"""The arm comes from here, along the board's normal, and leaves the same way."""
_ACCELERATION_RAD_S2 = 0.3
_PLATE_RODS = 41
_PLATE_M = 0.005
"""The board as the checks see it is at least this thick on both sides."""
_CHECKED_M = 0.005
"""Half of what the path check takes off every margin (limits.SPACING_M)."""
_DOUBT_SIGMAS = 3.0
_ROLLS = 24
_SAME_POSTURE_RAD = 1.0
"""Straight down turns no joint further than this; more means another posture of the arm."""
_TRIED_WAYS = 60


@dataclass(frozen=True, eq=False)
class HoverPath:
    """One path to one place over the board; a motion approval for it is bound to it."""

    plan: Plan
    check: PlanCheck
    geometry: CellGeometry
    corner: int
    standoff_m: float
    base_from_board: Array
    outward: Array
    """(3,) unit normal in `board`, to the side that the camera sees."""


@dataclass(frozen=True, eq=False)
class HoverQuestion:
    """The request, and where the arm stands: plain data that crosses into the worker."""

    corner: int
    standoff_m: float
    pointer: PointerConfig
    joints_rad: Vector6
    """Where the arm stands."""
    model_miss_m: float = 0.0
    """Distance of the arm's own flange position from the configured kinematics, there."""


def least_standoff_m(doubt_m: float) -> float:
    """Smallest standoff of the tip; `doubt_m`: how far board and tip may be off, all told."""
    return CLEARANCE_M + _PLATE_M + _CHECKED_M + doubt_m


def hover_target(
    base_from_board: Array,
    corner_m: Array,
    outward: Array,
    standoff_m: float,
    pointer: PointerConfig,
    roll: float,
) -> Array:
    """base_from_flange (4, 4): the tip `standoff_m` above the corner, the pointer along the normal.

    `corner_m`, `outward` (3,) in `board`; `roll` (rad) about the pointer is free.
    """
    down = -base_from_board[:3, :3] @ outward
    along = np.array(pointer.along) / np.linalg.norm(pointer.along)
    R = rotation_exp(roll * down) @ _turn(along, down)
    tip = transform_points(base_from_board, corner_m + standoff_m * outward)
    return pose(R, tip - R @ np.array(pointer.tip_m))


def _turn(start: Array, end: Array) -> Array:
    """A rotation (3, 3) that brings one unit vector onto another."""
    axis, cosine = np.cross(start, end), float(start @ end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        if cosine > 0:
            return np.eye(3)
        axis = np.linalg.svd(start[None])[2][2]  # any axis across serves for half a turn
        return rotation_exp(np.pi * axis)
    return rotation_exp(axis / sine * np.arctan2(sine, cosine))


def plan_hover(
    config: StationConfig,
    X: Array,
    base_from_board: Array,
    outward: Array,
    asked: HoverQuestion,
    doubt_m: float,
) -> HoverPath:
    """Plans the shortest free path over a corner, from where the arm stands. LimitError says what blocks it.

    X: flange_from_camera or base_from_camera of the calibration. Two moves: to a point `APPROACH_M` over the
    corner, then straight down the normal to the standoff.
    """
    corner, standoff_m = asked.corner, asked.standoff_m
    if not standoff_m >= (least_m := least_standoff_m(doubt_m)):
        raise LimitError(
            f"{1000 * standoff_m:.0f} mm above the board is too near: {1000 * CLEARANCE_M:.0f} mm are kept "
            f"whatever is uncertain (limit {np.ceil(1000 * least_m):.0f} mm)",
            code="standoff-too-small",
            remedy="Give a larger --standoff-mm; the rest is done by hand.",
            standoff_m=standoff_m,
            limit_m=least_m,
        )
    geometry = hover_geometry(config, X, base_from_board, doubt_m, asked.pointer)
    refused: PlanCheck | None = None
    ways = _ways(geometry.model, base_from_board, board_points(config.board)[corner], outward, asked)
    free = _free_ends(geometry, ways)
    for high, low in free[:_TRIED_WAYS] or ways[:1]:
        plan = _plan(config, geometry.model, corner, high, low)
        check = check_plan(plan, asked.joints_rad, geometry)
        if not check.problems:
            return HoverPath(plan, check, geometry, corner, standoff_m, base_from_board, outward)
        refused = refused or check
    where = f"corner {corner} with the tip {1000 * standoff_m:.0f} mm above it"
    if refused is None:
        raise LimitError(
            f"{where} is out of the arm's reach",
            code="corner-out-of-reach",
            remedy="Choose another corner, or move the board.",
            corner=corner,
        )
    problems = "\n".join(str(problem) for problem in refused.problems[:4])
    raise LimitError(
        f"No path to {where} is free. Nothing moved; the shortest one:\n{problems}",
        code="corner-path-blocked",
        remedy="Choose another corner, or move the board.",
        corner=corner,
    )


def hover_geometry(
    config: StationConfig, X: Array, base_from_board: Array, doubt_m: float, pointer: PointerConfig
) -> CellGeometry:
    """The cell with the board where it was just seen, the pointer on the flange, and slow limits."""
    low, high = board_extent(config.board)
    if config.mount == "eye-in-hand":
        cell = geometry_of(config, X, base_from_board, 0.0)
        others: tuple[Capsule, ...] = ()
    else:
        cell = geometry_of(config, X, None, 0.0)
        others = cell.obstacles
    along = np.array(pointer.along) / np.linalg.norm(pointer.along)
    end = np.array(pointer.tip_m) - pointer.radius_m * along
    rod = Capsule("pointer", (0.0, 0.0, 0.0), vector3(end), pointer.radius_m)
    return replace(
        slower(cell, speed_m_s=SPEED_M_S, joint_acceleration_rad_s2=_ACCELERATION_RAD_S2),
        solids=(*cell.solids, rod),
        obstacles=(*plate("board", base_from_board, low, high, _PLATE_RODS), *others),
        obstacle_clearance_m=CLEARANCE_M + doubt_m,
        watched_m=(*cell.watched_m, pointer.tip_m),
    )


def _ways(
    model: RobotModel, base_from_board: Array, point: Array, outward: Array, asked: HoverQuestion
) -> list[tuple[Array, Array]]:
    """Joints over the corner, high (6,) and low (6,): every roll and arm posture, the shortest turn first."""
    found: list[tuple[float, Array, Array]] = []
    start = asked.joints_rad
    for roll in np.arange(_ROLLS) * 2 * np.pi / _ROLLS:
        high, low = (
            hover_target(base_from_board, point, outward, above_m, asked.pointer, roll)
            for above_m in (max(asked.standoff_m, APPROACH_M), asked.standoff_m)
        )
        lows = list(_postures(model, low, start))
        for joints in _postures(model, high, start):
            below = min(lows, key=lambda low: float(np.abs(low - joints).max()), default=None)
            if below is not None and np.abs(below - joints).max() < _SAME_POSTURE_RAD:
                found.append((float(np.abs(joints - start).max()), joints, below))
    found.sort(key=lambda way: way[0])
    return [(joints, below) for _, joints, below in found]


def _free_ends(geometry: CellGeometry, ways: list[tuple[Array, Array]]) -> list[tuple[Array, Array]]:
    """Those paths whose two stops keep every clearance; what lies between is not looked at."""
    if not ways:
        return []
    gaps = margins(geometry, np.array(ways).reshape(-1, 6))[0].min(axis=1).reshape(-1, 2).min(axis=1)
    return [way for way, gap in zip(ways, gaps, strict=True) if gap >= _CHECKED_M]


def _postures(model: RobotModel, target: Array, near: Sequence[float]) -> Iterator[Array]:
    """Every arm posture (6,) for a flange pose, whole turns chosen near `near`."""
    for joints in turned_near(model, inverse_all(model, target), np.array(near)):
        exact = _refined(model, target, joints)
        if exact is not None:
            yield exact


def _refined(model: RobotModel, target: Array, joints: Array) -> Array | None:
    """Newton's method on the calibrated arm, which the analytic inverse does not know; None: no root."""
    joints = joints.copy()
    for _ in range(12):
        miss = difference(target, forward(model, joints))
        if np.abs(miss).max() < 1e-9:
            return joints
        step = np.linalg.lstsq(jacobian(model, joints), miss, rcond=1e-6)[0]
        joints = joints + step * min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-12))
    return None


def _plan(config: StationConfig, model: RobotModel, corner: int, high: Array, low: Array) -> Plan:
    poses = (
        pose_at(model, "approach", high, f"high over corner {corner}"),
        pose_at(model, "hover", low, f"the tip over corner {corner}"),
    )
    limits = config.limits
    return Plan(
        config.robot.model,
        config.mount,
        poses,
        joint_speed_rad_s=limits.joint_speed_rad_s,
        joint_acceleration_rad_s2=_ACCELERATION_RAD_S2,
        note="verification hover",
    )


def answer_hover(
    config: StationConfig, calibration: Calibration, view: BoardView, question: HoverQuestion
) -> tuple[HoverPath, Array, float]:
    """A checked path, from one image of the board. LimitError, BadViewsError.

    With the covariance (3, 3) of tip minus corner in `board`, m², and how far the board was moved, m.
    """
    now = locate_board(calibration, view, config.board)
    points = found_points(calibration, config.board)
    tip = np.array(question.pointer.tip_m)
    covariance = offset_covariance(calibration, view, now, points[question.corner], tip)
    worst = max(
        float(np.linalg.eigvalsh(offset_covariance(calibration, view, now, points[k], tip))[-1])
        for k in outer_corners(config.board)
    )
    doubt_m = _DOUBT_SIGMAS * float(np.sqrt(worst)) + question.model_miss_m
    X = calibration.transform.matrix
    hover = plan_hover(config, X, now.base_from_board, now.outward, question, doubt_m)
    return hover, covariance, now.moved_m
