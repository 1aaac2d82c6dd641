"""What a user may rely on: a plan is safe, varied, seen, short, the same for the same seed, or explained."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import cv2
import msgspec
import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS, forward, inverse_many
from calibrate.boards.model import board_points
from calibrate.handeye.information import covariance_of
from calibrate.handeye.metrics import point_error_m
from calibrate.views.corners import Corners
from calibrate.views.view_set import BoardView
from recordings.geometry import (
    matrix_from_quaternion,
    perturb,
    quaternion_from_matrix,
    rotation_angle,
    rotation_exp,
)
from station.analysis.estimation import running_estimate
from station.cell.config import SPEED_CAP_M_S
from station.cell.layout import cell_geometry, layout_of
from station.cell.limits import check_plan
from station.plan.candidates import NOT_IN_PICTURE, OUT_OF_REACH, find_candidates
from station.plan.choose import arm_objective, camera_objective, choose, informations
from station.plan.planner import PlanOptions, make_plan, plan_layout, predicted_errors_m
from station.plan.visibility import ViewRange, lens_radius, view_range, visible
from station.simulation.cells import cell_config, make_cell
from tests.codes import raises
from tests.station.true_camera import board_seen, corners_seen

CELLS = [
    ("paper", "eye-in-hand", 0),
    ("paper", "eye-in-hand", 3),
    ("paper", "eye-to-hand", 1),
]


FEW = PlanOptions(pool=150)
"""Fewer candidates than usual (1200), for what does not depend on their number."""


@cache
def cell(scene="paper", mount="eye-in-hand", seed=0):
    truth = make_cell(scene, seed, "low", mount)
    return truth, cell_config(truth)


@cache
def planned(scene="paper", mount="eye-in-hand", seed=0, count=25):
    truth, config = cell(scene, mount, seed)
    return plan_layout(layout_of(config), replace(FEW, count=count, seed=1), truth.start_joints_rad)


@pytest.mark.parametrize("which", CELLS)
def test_25_poses_pass_the_check_and_fit_into_a_minute(which):
    truth, config = cell(*which)
    plan = planned(*which)
    check = check_plan(plan, truth.start_joints_rad, cell_geometry(config))
    assert len(plan.poses) == 25
    assert check.problems == ()
    assert check.duration_s < 60
    assert check.top_speed_m_s <= SPEED_CAP_M_S


@pytest.mark.parametrize("which", CELLS)
def test_the_true_camera_sees_the_whole_board_from_every_pose(which):
    """By OpenCV's projection of the truth, which the planner never saw."""
    truth, _ = cell(*which)
    points = board_points(truth.board)
    for pose in planned(*which).poses:
        E = forward(MODELS["UR10"], pose.joints_rad)
        C = board_seen(truth, E)
        K, D = np.array(truth.camera.matrix), np.array(truth.camera.distortion or (0.0,) * 5)
        pixels = cv2.projectPoints(points, cv2.Rodrigues(C[:3, :3])[0], C[:3, 3], K, D)[0].reshape(-1, 2)
        assert (C[:3, :3] @ points.T + C[:3, 3:])[2].min() > 0.1
        assert pixels.min() > 0
        assert (pixels < [truth.camera.width, truth.camera.height]).all()


def test_poses_are_varied_and_say_why_they_are_there():
    plan = planned()
    views = [pose.view for pose in plan.poses]
    tilts = np.rad2deg([v.tilt_rad for v in views])
    assert np.ptp([v.distance_m for v in views]) > 0.1
    assert tilts.max() > 25 and tilts.max() < 45
    E = np.array([pose.base_from_flange for pose in plan.poses])
    turns = [rotation_angle(a[:3, :3].T @ b[:3, :3]) for a in E for b in E]
    assert np.rad2deg(max(turns)) > 45
    assert all("mm" in pose.why and "tilt" in pose.why for pose in plan.poses)
    sigmas = [pose.predicted_sigma_m for pose in plan.poses]
    assert all(b <= a * (1 + 1e-9) for a, b in pairwise(sigmas))
    assert 0.0001 < plan.floor_m < sigmas[-1] < 0.001


def test_the_error_is_larger_with_an_arm_of_a_class_that_misses_by_more():
    truth, config = cell()

    def end(arm_class):
        robot = msgspec.structs.replace(config.robot, arm_class=arm_class)
        plan = plan_layout(
            layout_of(msgspec.structs.replace(config, robot=robot)), FEW, truth.start_joints_rad
        )
        return plan.poses[-1].predicted_sigma_m, plan.floor_m

    ur_m, ur_floor_m = end("universal-robots")
    servo_m, servo_floor_m = end("servo")
    assert end("")[0] == ur_m, "the model's name tells the class"
    assert servo_m > 3 * ur_m and servo_floor_m > 3 * ur_floor_m
    assert servo_floor_m > 0.7 * servo_m, "hardly any of it is lowered by poses"


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_capturing_the_plan_shows_the_error_that_it_predicts(mount):
    """Corners twice as good as assumed, and an arm as its class has it: capture shows a little less."""
    truth, config = cell(mount=mount, seed=3)
    plan = planned(mount=mount, seed=3)
    rng = np.random.default_rng(3)
    seen = []
    for index, pose in enumerate(plan.poses):
        told = np.array(pose.base_from_flange)
        there = perturb(told, rng.normal(size=6) * np.repeat([1e-4, 1.7e-4], 3))
        pixels = corners_seen(truth, board_seen(truth, there), rng)
        corners = Corners(board_points(truth.board), pixels)
        seen.append(BoardView(index, pose.name, told, corners, np.array(pose.joints_rad)))
    shown = running_estimate(config, config.camera.model, False, seen)
    assert shown.predicted_error_mm == pytest.approx(1e3 * plan.poses[-1].predicted_sigma_m, rel=0.35)
    assert shown.floor_mm == pytest.approx(1e3 * plan.floor_m, rel=0.35)


@pytest.mark.parametrize("criterion", ["A", "arm"])
def test_the_error_without_some_of_the_poses_is_predicted_as_with_all(criterion):
    truth, config = cell()
    plan = plan_layout(layout_of(config), replace(FEW, criterion=criterion), truth.start_joints_rad)
    planned_m = [pose.predicted_sigma_m for pose in plan.poses]
    every = range(len(plan.poses))
    assert predicted_errors_m(config, plan, every) == pytest.approx(planned_m, rel=0.01)
    half_m = predicted_errors_m(config, plan, every[::2])
    assert len(half_m) == len(every[::2])
    assert half_m[-1] > 1.05 * planned_m[-1]
    assert predicted_errors_m(config, plan, ()) == []


def test_all_poses_stand_in_one_arm_branch():
    q = np.array([pose.joints_rad for pose in planned().poses])
    rows, joints, branches = inverse_many(MODELS["UR10"], forward(MODELS["UR10"], q))
    same = np.abs(np.exp(1j * joints) - np.exp(1j * q[rows])).max(axis=1) < 1e-6
    assert sorted(rows[same]) == list(range(len(q))) and len(set(branches[same])) == 1


def test_the_same_seed_gives_the_same_plan_and_another_seed_another():
    truth, config = cell()
    told = []

    def again(seed):
        options, start = replace(FEW, seed=seed), truth.start_joints_rad
        return plan_layout(layout_of(config), options, start, lambda _, done: told.append(done))

    assert again(1) == planned() and told == sorted(told) and told[-1] == 1.0
    assert again(2).poses != planned().poses


def test_the_choice_beats_random_poses_of_the_same_pool_and_keeps_what_is_chosen():
    _, config = cell()
    scene = layout_of(config)
    rng = np.random.default_rng(0)
    pool = find_candidates(scene, replace(view_range(scene), doubt=0.0), 200, rng, None)
    each = informations(scene, pool.base_from_flange)
    objective = camera_objective(scene.camera, scene.board, scene.working_distance_m, True)
    best = float(objective(each[choose(each, 15, objective, rng)].sum(axis=0)))
    scores = [float(objective(each[rng.permutation(len(each))[:15]].sum(axis=0))) for _ in range(40)]
    assert best < min(scores)
    chosen = choose(each, 8, objective, rng, keep=(3, 5))
    assert chosen[:2] == [3, 5]
    assert len(set(chosen)) == 8


def test_poses_for_the_arm_tell_more_of_its_table_than_poses_for_the_camera():
    truth, config = cell()
    scene, error_m = layout_of(config), []
    for criterion in ("arm", "A"):
        plan = plan_layout(scene, PlanOptions(pool=600, criterion=criterion), truth.start_joints_rad)
        joints = np.array([pose.joints_rad for pose in plan.poses])
        gained = informations(scene, forward(scene.geometry.model, joints), joints).sum(axis=0)
        error_m.append(np.exp(arm_objective(scene, True, joints)(gained) / 2))
    assert error_m[0] < 0.95 * error_m[1]


moved = msgspec.structs.replace


def turned(guess, rotvec):
    q = quaternion_from_matrix(matrix_from_quaternion(guess.rotation_xyzw) @ rotation_exp(rotvec))
    return moved(guess, rotation_xyzw=tuple(q.tolist()))


def narrow(config):
    start = np.array(cell()[0].start_joints_rad)
    return moved(config.limits, joints_min_rad=tuple(start - 0.12), joints_max_rad=tuple(start + 0.12))


SMALL_BOX = {"workspace_min_m": (0.6, -0.1, 0.3), "workspace_max_m": (0.7, 0.05, 0.5)}
IMPOSSIBLE = {
    "the table": lambda c: moved(c, board_guess=turned(c.board_guess, [np.pi, 0, 0])),
    "the workspace box": lambda c: moved(c, limits=moved(c.limits, **SMALL_BOX)),
    "the joint range": lambda c: moved(c, limits=narrow(c)),
    "the camera looks back": lambda c: moved(c, camera_guess=turned(c.camera_guess, [0, np.pi, 0])),
    NOT_IN_PICTURE: lambda c: moved(c, camera_guess=moved(c.camera_guess, sigma_rad=0.6)),
    OUT_OF_REACH: lambda c: moved(c, board_guess=moved(c.board_guess, translation_m=(2.2, 0.0, 0.0))),
}
"""What limits, and the change that makes it so."""


@pytest.mark.parametrize(
    ("limit", "mount"), [*((limit, "eye-in-hand") for limit in IMPOSSIBLE), (OUT_OF_REACH, "eye-to-hand")]
)
def test_an_impossible_plan_is_explained(limit, mount):
    """A fixed camera is turned away from the arm."""
    truth, config = cell("paper", mount, int(mount == "eye-to-hand"))
    change = IMPOSSIBLE["the camera looks back" if mount == "eye-to-hand" else limit]
    with raises("too-few-poses", wanted=25) as caught:
        plan_layout(layout_of(change(config)), FEW, truth.start_joints_rad)
    assert caught.value.values["limiting"].startswith(limit)
    assert caught.value.remedy


def test_what_planning_needs_is_asked_for():
    _, config = cell()
    for code, changes in (
        ("no-guess", {"board_guess": None}),
        ("no-guess", {"camera_guess": None}),
        ("guess-too-rough", {"camera_guess": moved(config.camera_guess, sigma_m=0.06)}),
        ("no-lens", {"camera": moved(config.camera, model=None)}),
        ("unknown-robot-model", {"robot": moved(config.robot, model="UR10000")}),
    ):
        with raises(code):
            make_plan(moved(config, **changes))


def test_a_folding_lens_does_not_show_points_that_it_cannot_see():
    _, config = cell()
    folding = moved(config.camera.model, distortion=(-0.9, 0.0, 0.0, 0.0, 0.0))
    edge = lens_radius(folding)
    assert edge == pytest.approx(1 / np.sqrt(3 * 0.9), rel=0.02)
    outside = np.array([[[1.02 * edge, 0.0, 1.0]]])
    assert not visible(folding, outside, 0.0)[0]
    behind = np.array([[[0.0, 0.0, -0.5]]])
    assert not visible(config.camera.model, behind, 0.0)[0]


@pytest.mark.parametrize(
    ("kind", "distortion"),
    [
        ("plumb_bob", (-0.1, 0.1, 0.0, 0.0)),
        ("rational_polynomial", (-0.1, 0.1, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0)),
        ("equidistant", (0.05, -0.01, 0.0, 0.0)),
    ],
)
def test_every_lens_model_can_be_planned_with(kind, distortion):
    truth, config = cell()
    lens = moved(config.camera.model, distortion=distortion, distortion_model=kind)
    other = moved(config, camera=moved(config.camera, model=lens))
    plan = plan_layout(layout_of(other), replace(FEW, count=6), truth.start_joints_rad)
    assert len(plan.poses) == 6
    assert plan.poses[-1].predicted_sigma_m < 0.01


def test_a_plan_without_a_start_and_with_few_poses():
    _, config = cell()
    plan = plan_layout(layout_of(config), replace(FEW, count=4, view=replace(ViewRange(), doubt=1.0)))
    assert len(plan.poses) == 4
    assert check_plan(plan, None, cell_geometry(config)).problems == ()


def test_six_poses_for_a_known_lens_tell_more_of_where_the_camera_sits():
    """A drift check asks for them so: the installed calibration knows the lens."""
    truth, config = cell()
    scene, errors_m = layout_of(config), []
    prior = camera_objective(scene.camera, scene.board, scene.working_distance_m, False).prior
    for known in (False, True):
        options = replace(FEW, count=6, free_intrinsics=not known)
        plan = plan_layout(scene, options, truth.start_joints_rad)
        flange = np.array([pose.base_from_flange for pose in plan.poses])
        gained = informations(scene, flange).sum(axis=0)
        errors_m.append(point_error_m(scene.X, covariance_of(gained, prior)[:6, :6], 0.0))
    assert errors_m[1] < 0.9 * errors_m[0]
