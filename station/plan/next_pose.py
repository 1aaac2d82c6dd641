"""The most useful next pose after captured ones, and how many are missing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from calibrate.geometry import Array
from calibrate.handeye.information import sigma_of
from station.cell.config import StationConfig
from station.cell.errors import StationError
from station.cell.layout import CellLayout, layout_of
from station.cell.limits import check_path
from station.cell.pose_plan import PlannedPose
from station.plan.candidates import find_candidates
from station.plan.choose import Objective, informations, objective_for
from station.plan.visibility import planned_pose, view_range

_FURTHER_POSES, _CANDIDATES, _TRIES = 60, 150, 12


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
    missing = f"At least {poses} more pose{'s' * (poses > 1)}" if poses else "Many more poses"
    return f"{missing} for {1000 * goal_m:.2g} mm. The most useful one: {pose.why}."
