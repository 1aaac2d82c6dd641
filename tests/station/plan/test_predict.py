"""Forecasts fall as poses come in; advice says enough when it is, and offers a pose that helps when not."""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np
import pytest

from calibrate.handeye.arm import PARAMETERS
from calibrate.handeye.information import MeasurementNoise
from calibrate.kinematics import forward
from station.cell.config import CaptureConfig
from station.cell.layout import layout_of
from station.cell.limits import check_path
from station.cell.pose_plan import PlannedPose
from station.plan.choose import CRITERIA
from station.plan.planner import PlanOptions, plan_layout
from station.plan.predict import forecast_arm, forecast_views, next_best, next_best_text, with_forecast
from station.simulation.cells import cell_config, make_cell


@cache
def world():
    truth = make_cell("paper", 0, "low", "eye-in-hand")
    config = cell_config(truth)
    scene = layout_of(config)
    plan = plan_layout(scene, PlanOptions(pool=600), truth.start_joints_rad)
    return scene, plan, np.array([pose.base_from_flange for pose in plan.poses])


def test_the_forecast_is_what_the_plan_says_and_only_falls():
    scene, plan, _ = world()
    assert with_forecast(scene, plan) == (plan, ())
    silent = tuple(msgspec.structs.replace(pose, predicted_sigma_m=None) for pose in plan.poses)
    told, cut = with_forecast(scene, msgspec.structs.replace(plan, poses=silent))
    steps = [pose.predicted_sigma_m for pose in told.poses]
    assert cut == ()
    assert steps == pytest.approx([pose.predicted_sigma_m for pose in plan.poses], rel=1e-4)
    assert (np.diff(steps) <= 1e-12).all()


def test_a_pose_that_cuts_the_board_is_named_and_expected_to_bring_nothing():
    scene, plan, _ = world()
    a, b, c, d, e, f = plan.poses[8].joints_rad
    away = PlannedPose("away", (a, b, c, d, e + 0.5, f))
    poses = tuple(msgspec.structs.replace(pose, predicted_sigma_m=None) for pose in plan.poses[:9])
    told, cut = with_forecast(scene, msgspec.structs.replace(plan, poses=(*poses, away)))
    assert cut == ("away",)
    assert told.poses[9].predicted_sigma_m == told.poses[8].predicted_sigma_m


def test_a_known_lens_and_less_noise_make_it_better():
    scene, _, flange = world()
    usual = forecast_views(scene, flange)[-1]
    assert forecast_views(scene, flange, free_intrinsics=False)[-1] < usual
    half = MeasurementNoise(0.075, 5e-5, 8.5e-5)
    assert forecast_views(scene, flange, noise=half)[-1] == pytest.approx(usual / 2, rel=0.05)


def test_the_next_best_pose_helps_and_is_free_to_reach():
    scene, plan, flange = world()
    here = np.array(plan.poses[7].joints_rad)
    pose, missing = next_best(scene, flange[:8], 0.00025, here)
    assert check_path(scene.geometry, here, pose.joints_rad).problems == ()
    more = np.concatenate([flange[:8], forward(scene.geometry.model, pose.joints_rad)[None]])
    before, after = forecast_views(scene, more)[-2:]
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
    assert "more for 0.5 mm" in text and "next best" in text and "tilt" in text
    assert next_best_text(config, flange, plan.poses[-1].joints_rad) == ""
    strict = msgspec.structs.replace(config, capture=CaptureConfig(goal_m=1e-4))
    assert "for 0.1 mm" in next_best_text(strict, flange, plan.poses[-1].joints_rad)
    unknown = msgspec.structs.replace(config, board_guess=None)
    assert next_best_text(unknown, flange[:5], plan.poses[4].joints_rad) == ""


@pytest.mark.parametrize(("aim", "share"), [("arm", 0.95), ("both", 1.0)])
def test_poses_for_the_arm_tell_more_of_its_table_than_poses_for_the_camera(aim, share):
    scene, plan, _ = world()
    truth = make_cell("paper", 0, "low", "eye-in-hand")
    start = truth.start_joints_rad
    own = plan_layout(scene, PlanOptions(pool=600, criterion=CRITERIA[aim]), start)
    planned, usual = forecast_arm(scene, own), forecast_arm(scene, plan)
    assert planned.with_table_m < share * usual.with_table_m
    assert planned.if_measured_m <= planned.with_table_m
    assert set(planned.open) <= set(PARAMETERS)


def test_a_single_view_leaves_the_table_open_and_a_measured_board_helps():
    scene, plan, _ = world()
    few = forecast_arm(scene, msgspec.structs.replace(plan, poses=plan.poses[:4]))
    assert len(few.open) > len(forecast_arm(scene, plan).open)
    assert few.with_table_m > forecast_arm(scene, plan).with_table_m
