"""Whole-path checks: what is refused, how it is named, and how fast a move may be."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS, forward
from recordings.geometry import rotation_exp
from station.cell.collision import SPACING_M, CellGeometry, margins, moving_points, plate
from station.cell.config import SPEED_CAP_M_S, Capsule, LimitsConfig, Plane
from station.cell.limits import (
    JOINT_ACCELERATION_CAP_RAD_S2,
    JOINT_SPEED_CAP_RAD_S,
    check_path,
    check_plan,
    leaving,
    sample_path,
    trapezoid,
)
from station.cell.pose_plan import Plan, PlannedPose

REST = np.deg2rad([0.0, -100.0, -100.0, -70.0, 90.0, 0.0])
FREE = CellGeometry(MODELS["UR10"], LimitsConfig(), watched_m=((0.0, -0.06, 0.087),))


def plan_of(*joints, robot="UR10", **extra):
    poses = tuple(PlannedPose(f"p{i}", tuple(float(a) for a in q)) for i, q in enumerate(joints))
    return Plan(robot=robot, mount="eye-in-hand", poses=poses, **extra)


def test_no_configuration_raises_the_caps():
    wild = LimitsConfig(speed_m_s=5.0, joint_speed_rad_s=9.0, joint_acceleration_rad_s2=99.0)
    geometry = CellGeometry(MODELS["UR10"], wild)
    sweep = check_path(geometry, REST, REST + np.array([0.8, 0, 0, 0, 0, 0]))
    assert sweep.top_speed_m_s <= SPEED_CAP_M_S
    assert sweep.joint_acceleration_rad_s2 == JOINT_ACCELERATION_CAP_RAD_S2
    turn = check_path(geometry, REST, REST + np.array([0, 0, 0, 0, 0, 2.0]))
    assert turn.joint_speed_rad_s == JOINT_SPEED_CAP_RAD_S


def test_a_plan_may_be_slower_than_the_configuration_but_not_faster():
    there = REST + np.array([0, 0, 0, 0, 0, 2.0])
    usual = check_plan(plan_of(there), REST, FREE).moves[0]
    slow = check_plan(plan_of(there, joint_speed_rad_s=0.1), REST, FREE).moves[0]
    fast = check_plan(plan_of(there, joint_speed_rad_s=9.0), REST, FREE).moves[0]
    assert slow.joint_speed_rad_s == 0.1
    assert fast.joint_speed_rad_s == usual.joint_speed_rad_s == FREE.limits.joint_speed_rad_s
    soft = check_plan(plan_of(there, joint_acceleration_rad_s2=0.2), REST, FREE).moves[0]
    hard = check_plan(plan_of(there, joint_acceleration_rad_s2=9.0), REST, FREE).moves[0]
    assert soft.joint_acceleration_rad_s2 == 0.2
    assert hard.joint_acceleration_rad_s2 == FREE.limits.joint_acceleration_rad_s2


@pytest.mark.parametrize(
    "limits",
    [
        {"speed_m_s": 1e-6},
        {"joint_speed_rad_s": 1e-9},
        {"joint_acceleration_rad_s2": 1e-300},
    ],
)
def test_a_move_too_slow_to_be_told_from_none_is_refused(limits):
    geometry = CellGeometry(MODELS["UR10"], LimitsConfig(**limits))
    move = check_path(geometry, REST, REST + np.array([0.8, 0, 0, 0, 0, 0]))
    assert {problem.limit for problem in move.problems} == {"speed"}


def test_an_obstacle_between_two_good_poses_is_found():
    left, right = REST + np.array([0.5, 0, 0, 0, 0, 0]), REST - np.array([0.5, 0, 0, 0, 0, 0])
    at = forward(MODELS["UR10"], REST)[:3, 3]
    post = Capsule("post", (at[0], at[1], 0.0), (at[0], at[1], float(at[2])), 0.01)
    geometry = CellGeometry(MODELS["UR10"], LimitsConfig(), obstacles=(post,), obstacle_clearance_m=0.02)
    assert margins(geometry, np.array([left, right]))[0].min() > 0
    problems = check_path(geometry, left, right, "pose 7").problems
    assert problems
    assert all(p.pose == "pose 7" and p.limit == "clearance" for p in problems)
    assert "wrist 3 against the post" in {problem.of for problem in problems}


def test_what_is_no_number_is_not_free():
    lost = Capsule("post", (np.nan, 0.0, 0.0), (0.0, 0.0, 0.1), 0.01)
    problems = check_path(
        CellGeometry(MODELS["UR10"], LimitsConfig(), obstacles=(lost,)), REST, REST + 0.1
    ).problems
    assert {problem.limit for problem in problems} == {"clearance"}


def test_a_plate_of_several_rods_is_one_problem():
    """A board on the flange, driven into the table."""
    board = plate("board", np.eye(4), np.array([-0.1, -0.1]), np.array([0.1, 0.1]))
    limits = LimitsConfig(planes=(Plane("table", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),))
    cell = CellGeometry(MODELS["UR10"], limits, solids=board)
    down = (0.0, -0.4, 1.4, -2.6, -1.57, 0.0)
    gaps, contacts = margins(cell, np.array([down]))
    worst_m = min(
        gap for gap, contact in zip(gaps[0], contacts, strict=True) if contact == ("board", "table", "plane")
    )
    [told] = [p.text for p in check_path(cell, down, down).problems if p.of == "board against table"]
    assert told.startswith(f"board against table, {-1000 * (worst_m - SPACING_M / 2):.0f} mm too close")


@pytest.mark.parametrize("turn", [1.0, LimitsConfig().joint_step_rad, 2 * np.pi])
def test_samples_lie_as_dense_when_every_joint_turns_far(turn):
    """Joints that turn against each other bend the way: a chord over an eighth of it is too short."""
    rng = np.random.default_rng(0)
    for _ in range(60):
        start = rng.uniform(-6.2, 6.2, 6)
        target = start + rng.choice([-1, 1], 6) * rng.uniform(0.3, 1.0, 6) * turn
        travel = np.diff(moving_points(FREE, sample_path(FREE, start, target, SPACING_M)), axis=0)
        assert np.linalg.norm(travel, axis=-1).max() <= SPACING_M


def test_a_plan_for_the_other_mount_is_refused():
    cell = CellGeometry(MODELS["UR10"], LimitsConfig(), mount="eye-to-hand")
    [problem] = check_plan(plan_of(REST), REST, cell).problems
    assert problem.limit == "mount"


def test_joint_range_and_step_name_the_joint():
    limits = LimitsConfig(joints_max_rad=(6.28, 6.28, 6.28, 6.28, 6.28, 0.5), joint_step_rad=0.3)
    problems = check_path(
        CellGeometry(MODELS["UR10"], limits), REST, REST + np.array([0, 0, 0, 0, 0, 0.6])
    ).problems
    assert {(p.limit, p.of) for p in problems} == {("joint range", "wrist 3"), ("joint step", "wrist 3")}
    limits = LimitsConfig(joints_min_rad=(-0.2, *(-6.28,) * 5))
    below = check_path(CellGeometry(MODELS["UR10"], limits), REST, REST - np.array([0.3, 0, 0, 0, 0, 0]))
    assert [(p.limit, p.of) for p in below.problems] == [("joint range", "base")]
    beyond = check_path(FREE, REST, REST + np.array([6.4, 0, 0, 0, 0, 0])).problems
    assert ("joint range", "base") in {(p.limit, p.of) for p in beyond}


@pytest.mark.parametrize(
    ("bad", "limits"),
    [
        ([np.nan] * 6, {"joints"}),
        ([0.0] * 5, {"joints"}),
        ([np.inf, 0, 0, 0, 0, 0], {"joints"}),
        (np.rad2deg(REST) * 1e6, {"joint range", "joint step"}),  # at once: it is not sampled
    ],
)
def test_joints_that_are_no_joints_are_a_problem_not_a_crash(bad, limits):
    move = check_path(FREE, REST, bad)
    assert {p.limit for p in move.problems} == limits
    assert move.joint_speed_rad_s == 0.0


def test_an_arm_that_stands_too_close_may_leave_but_not_come_nearer():
    table = Plane("table", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))

    def cell(clearance_m):
        return CellGeometry(MODELS["UR10"], LimitsConfig(planes=(table,), clearance_m=clearance_m))

    gaps, contacts = margins(cell(1e-9), REST)
    lowest = min(gap for gap, contact in zip(gaps[0], contacts, strict=True) if contact.other == "table")
    near = cell(float(lowest) + 0.03)
    up, down = REST + np.array([0, 0.3, 0, 0, 0, 0]), REST - np.array([0, 0.05, 0, 0, 0, 0])
    assert [gap.min() > 0 for gap in margins(near, np.array([REST, up, down]))[0]] == [False, True, False]
    assert check_path(near, REST, up).problems == ()
    assert check_path(near, REST, down).problems


def test_leaving_excuses_only_an_unbroken_retreat_that_ends_outside():
    retreat = np.array([[-0.03], [-0.02], [-0.01], [0.02]])
    assert leaving(retreat).min() == 0.0
    assert leaving(np.array([[-0.03], [-0.02], [-0.025], [0.02]])).min() < 0
    assert leaving(np.array([[-0.03], [0.02], [-0.01], [0.02]])).min() < 0
    assert leaving(np.array([[-0.03], [-0.02], [-0.01]])).min() < 0
    slide = np.array([[-0.03]] * 9 + [[0.02]])  # along a wall
    assert leaving(slide).min() < 0
    assert leaving(slide + np.linspace(0, 0.005, 10)[:, None]).min() < 0


def test_check_plan_names_pose_robot_and_edited_flange():
    good = check_plan(plan_of(REST + 0.1, REST), REST, FREE)
    assert good.problems == ()
    assert len(good.moves) == 2
    assert good.duration_s > 0 and good.path_m > 0
    wrong = check_plan(plan_of(REST, robot="UR5"), REST, FREE)
    assert [problem.limit for problem in wrong.problems] == ["robot"]
    assert check_plan(plan_of(), REST, FREE).problems[0].limit == "poses"
    flange = forward(MODELS["UR10"], REST)
    flange[0, 3] += 0.02
    edited = msgspec.structs.replace(
        plan_of(REST).poses[0], base_from_flange=tuple(map(tuple, flange.tolist()))
    )
    problems = check_plan(msgspec.structs.replace(plan_of(), poses=(edited,)), REST, FREE).problems
    assert [(p.limit, p.pose) for p in problems] == [("flange pose", "pose 1 (p0)")]


@pytest.mark.parametrize(("by_m", "by_rad", "refused"), [(0.0018, 0.0045, 0), (0.0022, 0, 1), (0, 0.0055, 1)])
def test_an_expected_flange_may_differ_by_its_rounding_only(by_m, by_rad, refused):
    flange = forward(MODELS["UR10"], REST)
    flange[1, 3] += by_m
    flange[:3, :3] = flange[:3, :3] @ rotation_exp([0.0, by_rad, 0.0])
    pose = PlannedPose("p0", tuple(REST), base_from_flange=tuple(map(tuple, flange.tolist())))
    assert len(check_plan(Plan("UR10", "eye-in-hand", (pose,)), REST, FREE).problems) == refused


def test_the_first_move_starts_where_the_arm_is():
    far = REST + np.array([1.2, 0, 0, 0, 0, 0])
    assert check_plan(plan_of(REST), far, FREE).moves[0].step_rad == pytest.approx(1.2)
    assert check_plan(plan_of(REST), None, FREE).moves[0].step_rad == 0.0


def test_trapezoid_times():
    duration, peak = trapezoid(1.0, 0.5, 1.0)
    assert (float(duration), float(peak)) == pytest.approx((2.5, 0.5))
    duration, peak = trapezoid(0.01, 0.5, 4.0)
    assert (float(duration), float(peak)) == pytest.approx((0.1, 0.2))
