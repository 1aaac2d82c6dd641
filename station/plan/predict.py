"""Predicted error of X from a plan or after captured poses, and the most useful next pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate.boards.model import board_points
from calibrate.geometry import Array
from calibrate.handeye.arm import PARAMETERS
from calibrate.handeye.information import USUAL_NOISE, MeasurementNoise, covariance_of, sigma_of
from calibrate.handeye.solution import MEASURED
from station.cell.config import StationConfig
from station.cell.errors import StationError
from station.cell.layout import CellLayout, flange_poses, layout_of
from station.cell.limits import check_path
from station.cell.pose_plan import Plan, PlannedPose
from station.plan.candidates import find_candidates
from station.plan.choose import TABLE_MM, Objective, informations, objective_for
from station.plan.visibility import planned_pose, view_range, visible

_FURTHER_POSES, _CANDIDATES, _TRIES = 60, 150, 12


_OPEN = 0.7
"""Share of its prior 1σ above which a parameter counts as not determined."""


@dataclass(frozen=True)
class ArmForecast:
    """Errors expected after a plan if X and the arm's table are estimated from it."""

    with_table_m: float
    """1σ of a point over the arm's workspace, with the corrected table."""
    if_measured_m: float
    """The same if the board's length is known to `MEASURED`."""
    open: tuple[str, ...]
    """Parameters of the table that the plan does not determine."""


def forecast_arm(layout: CellLayout, plan: Plan) -> ArmForecast:
    """Predict errors with the arm's table, for usual noise and usual errors of the table."""
    joints = np.array([pose.joints_rad for pose in plan.poses])
    gains = informations(layout, flange_poses(layout, plan), joints)
    total, expected = gains.sum(axis=0), []
    for tolerance in (layout.board.square_tolerance, MEASURED):
        board = msgspec.structs.replace(layout.board, square_tolerance=tolerance)
        objective = objective_for(
            replace(layout, board=board), "arm", free_intrinsics=True, joints_rad=joints
        )
        expected.append(float(np.exp(objective(total) / 2)))
        if tolerance is layout.board.square_tolerance:
            left = np.diag(covariance_of(total, objective.prior))[-len(PARAMETERS) :]
    wide = np.sqrt(left) > _OPEN * 1e-3 * TABLE_MM
    names = tuple(name for name, stays in zip(PARAMETERS, wide, strict=True) if stays)
    return ArmForecast(expected[0], expected[1], names)


def with_forecast(layout: CellLayout, plan: Plan) -> tuple[Plan, tuple[str, ...]]:
    """Add the expected sigma after each pose where it is missing, for usual noise.

    The second value names the poses in which the board is expected to be cut off.
    """
    flange = flange_poses(layout, plan)
    cut = tuple(pose.name for pose, seen in zip(plan.poses, _whole(layout, flange), strict=True) if not seen)
    if all(pose.predicted_sigma_m is not None for pose in plan.poses):
        return plan, cut
    expected = forecast_views(layout, flange)
    poses = tuple(
        msgspec.structs.replace(pose, predicted_sigma_m=after)
        for pose, after in zip(plan.poses, expected, strict=True)
    )
    return msgspec.structs.replace(plan, poses=poses), cut


def forecast_views(
    layout: CellLayout,
    base_from_flange: Array,
    free_intrinsics: bool = True,
    noise: MeasurementNoise = USUAL_NOISE,
) -> list[float]:
    """Predict 1σ of X (m) after each of the views from these flange poses (n, 4, 4).

    A view that is not expected to show the whole board adds nothing.
    """
    objective = objective_for(layout, "A", free_intrinsics)
    gains = informations(layout, base_from_flange, noise=noise)
    gains[~_whole(layout, base_from_flange)] = 0.0
    return [sigma_of(information, objective.prior)[0] for information in gains.cumsum(axis=0)]


def _whole(layout: CellLayout, base_from_flange: Array) -> NDArray[np.bool_]:
    """Tell for each pose whether all points of the board are expected in the image, (n,)."""
    return visible(layout.camera, layout.seen(base_from_flange, board_points(layout.board)), 0.0)


def next_best(
    layout: CellLayout, base_from_flange: ArrayLike, goal_m: float, joints_now_rad: Sequence[float]
) -> tuple[PlannedPose, int | None] | None:
    """Find the most useful next pose with a free path from where the arm is, after views from flange poses.

    The second value is the number of further poses that reach the goal (1σ of X's translation); None: too
    many. None without poses when the goal is reached, or when no pose is reachable.
    """
    flange = np.asarray(base_from_flange, dtype=float).reshape(-1, 4, 4)
    objective = objective_for(layout, "A", free_intrinsics=True)
    known = informations(layout, flange).sum(axis=0)
    if sigma_of(known, objective.prior)[0] <= goal_m:
        return None
    start = np.asarray(joints_now_rad, dtype=float)
    pool = find_candidates(layout, view_range(layout), _CANDIDATES, np.random.default_rng(0), start)
    gains = informations(layout, pool.base_from_flange)
    for place in np.argsort(objective(known + gains), kind="stable")[:_TRIES]:
        joints = pool.joints_rad[place]
        if not check_path(layout.geometry, start, joints).problems:
            after_m = sigma_of(known + gains[place], objective.prior)[0]
            pose = planned_pose(layout, len(flange), joints, after_m)
            return pose, _missing(known, gains, goal_m, objective)
    return None


def _missing(known: Array, gains: Array, goal_m: float, objective: Objective) -> int | None:
    """Count the further poses, chosen greedily, that reach the goal; None: too many."""
    total = known
    for count in range(1, _FURTHER_POSES + 1):
        total = total + gains[int(np.argmin(objective(total + gains)))]
        if sigma_of(total, objective.prior)[0] <= goal_m:
            return count
    return None


def next_best_text(config: StationConfig, base_from_flange: Array, joints_now_rad: Sequence[float]) -> str:
    """Say which pose would help most and how many are missing for `capture.goal_m`.

    Empty when none is missing, none helps, or the initial poses are missing.
    """
    goal_m = config.capture.goal_m
    try:
        found = next_best(layout_of(config), base_from_flange, goal_m, joints_now_rad)
    except StationError:
        return ""
    if found is None:
        return ""
    pose, poses = found
    missing = f"at best {poses} more" if poses else "many more poses"
    return f"{missing} for {1000 * goal_m:.2g} mm; the next best: {pose.why}"
