"""Advice says enough when it is, and offers a pose that helps when not."""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np
import pytest

from calibrate.handeye.information import sigma_of
from calibrate.kinematics import forward
from station.cell.config import CaptureConfig
from station.cell.layout import layout_of
from station.cell.limits import check_path
from station.plan.choose import informations, objective_for
from station.plan.next_pose import next_best, next_best_text
from station.plan.planner import PlanOptions, plan_layout
from station.simulation.cells import cell_config, make_cell


@cache
def world():
    truth = make_cell("paper", 0, "low", "eye-in-hand")
    config = cell_config(truth)
    scene = layout_of(config)
    plan = plan_layout(scene, PlanOptions(pool=600), truth.start_joints_rad)
    return scene, plan, np.array([pose.base_from_flange for pose in plan.poses])


def sigmas_m(scene, flange):
    """Expected error after each view, by the matrices that planning uses."""
    prior = objective_for(scene, "A", True).prior
    return [sigma_of(total, prior)[0] for total in informations(scene, flange).cumsum(axis=0)]


def test_the_next_best_pose_helps_and_is_free_to_reach():
    scene, plan, flange = world()
    here = np.array(plan.poses[7].joints_rad)
    pose, missing = next_best(scene, flange[:8], 0.00025, here)
    assert check_path(scene.geometry, here, pose.joints_rad).problems == ()
    more = np.concatenate([flange[:8], forward(scene.geometry.model, pose.joints_rad)[None]])
    before, after = sigmas_m(scene, more)[-2:]
    assert after < before and after == pytest.approx(pose.predicted_sigma_m, rel=1e-6)
    assert 1 < missing < 25


def test_a_goal_beyond_the_arm_is_not_promised():
    scene, plan, flange = world()
    _, missing = next_best(scene, flange, 1e-6, plan.poses[-1].joints_rad)
    assert missing is None


def test_the_session_names_the_next_best_pose_until_it_is_enough():
    config = cell_config(make_cell("paper", 0, "low", "eye-in-hand"))
    _, plan, flange = world()
    text = next_best_text(config, flange[:5], plan.poses[4].joints_rad)
    assert "for 0.5 mm" in text and "tilt" in text
    assert next_best_text(config, flange, plan.poses[-1].joints_rad) == ""
    strict = msgspec.structs.replace(config, capture=CaptureConfig(goal_m=1e-4))
    assert "for 0.1 mm" in next_best_text(strict, flange, plan.poses[-1].joints_rad)
    unknown = msgspec.structs.replace(config, board_guess=None)
    assert next_best_text(unknown, flange[:5], plan.poses[4].joints_rad) == ""
