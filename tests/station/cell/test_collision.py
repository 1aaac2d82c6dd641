"""Solids and distances against a brute-force oracle and postures whose answer is plain."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from calibrate.arms.kinematics import MODELS, forward, link_frames
from station.cell.collision import (
    ARM_BODIES,
    CellGeometry,
    body_segments,
    margins,
    moving_points,
    segment_distance,
)
from station.cell.config import Capsule, LimitsConfig, Plane

UPRIGHT = np.deg2rad([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])
coordinate = st.floats(-1, 1)
point = st.tuples(coordinate, coordinate, coordinate)


@settings(max_examples=80)
@given(point, point, point, point)
@example((0.0, 1e-5, 1e-5), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))  # they meet, nearly parallel
def test_segment_distance_is_the_smallest_over_all_pairs_of_points(a0, a1, b0, b1):
    a0, a1, b0, b1 = (np.array(p) for p in (a0, a1, b0, b1))
    share = np.linspace(0, 1, 101)[:, None]
    sampled = np.linalg.norm((a0 + share * (a1 - a0))[:, None] - (b0 + share * (b1 - b0))[None], axis=2).min()
    exact = float(segment_distance(a0, a1, b0, b1))
    assert exact <= sampled + 1e-5  # nearly parallel segments: exact to the angle that counts as parallel
    assert exact >= sampled - 0.01 * (np.linalg.norm(a1 - a0) + np.linalg.norm(b1 - b0)) - 1e-9


@pytest.mark.parametrize("name", sorted(MODELS))
def test_an_arm_at_ease_touches_nothing_of_itself(name):
    gaps, contacts = margins(CellGeometry(MODELS[name], LimitsConfig()), UPRIGHT)
    assert gaps.min() > 0, contacts[gaps[0].argmin()]


@pytest.mark.parametrize(
    ("plane", "met"),
    [
        (Plane("wall", (0.25, 0.0, 0.0), (-1.0, 0.0, 0.0)), True),
        (Plane("sloping wall", (0.2, 0.0, 0.0), (-1.0, 0.0, 0.6)), True),
        (Plane("table", (0.0, 0.0, 0.1), (0.05, 0.0, 1.0)), False),
    ],
)
def test_the_shoulder_meets_a_wall_but_no_table_that_it_stands_above(plane, met):
    """It turns about the base, level: it is near a wall at some angles only, near a table at all."""
    geometry = CellGeometry(MODELS["UR10"], LimitsConfig(planes=(plane,)))
    turns = UPRIGHT + np.linspace(0, 2 * np.pi, 60)[:, None] * [1, 0, 0, 0, 0, 0]
    turns[:, 1] = np.deg2rad(-150)  # the upper arm leans away from where the shoulder is
    starts, _, radii = body_segments(geometry, turns)
    normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
    shoulder = (starts[:, 2] - plane.point_m) @ normal - radii[2] - geometry.limits.clearance_m
    gaps, contacts = margins(geometry, turns)
    upper = gaps[:, contacts.index(("upper arm", plane.name, "plane"))]
    assert shoulder.min() < 0
    assert ((upper <= shoulder + 1e-9) | (shoulder > 0)).all() == met


def test_a_folded_wrist_runs_into_the_forearm():
    camera = Capsule("camera", (0.0, 0.0, 0.1), (0.0, 0.0, 0.18), 0.04)
    geometry = CellGeometry(MODELS["UR10"], LimitsConfig(), solids=(camera,))
    folded = np.deg2rad([0.0, -90.0, -90.0, 45.0, -135.0, 0.0])
    gaps, contacts = margins(geometry, np.array([UPRIGHT, folded]))
    assert gaps[0].min() > 0
    assert gaps[1].min() < 0
    assert contacts[gaps[1].argmin()] == ("forearm", "camera", "self")


def test_every_two_bodies_that_can_meet_are_held_against_each_other():
    """Neighbours always touch; a wrist and the one after the next are as far apart as they were built."""
    _, contacts = margins(CellGeometry(MODELS["UR10"], LimitsConfig()), UPRIGHT)
    apart = {(a, b) for b in range(len(ARM_BODIES)) for a in range(b - 1)}
    built = {(0, 2), (3, 5), (4, 6)}
    assert set(contacts) == {(ARM_BODIES[a], ARM_BODIES[b], "self") for a, b in apart - built}


def test_a_stretched_arm_lies_where_the_makers_model_shows_it():
    """Axes of the bodies of a UR10 with all joints at 0, from its drawing; the thickest first."""
    starts, ends, radii = body_segments(CellGeometry(MODELS["UR10"], LimitsConfig()), np.zeros((1, 6)))
    upper, fore, wrist = 0.2209, 0.0490, 0.163941
    height, elbow, last = 0.1273, -0.612, -0.612 - 0.5723
    axes = [
        ((0, 0, 0), (0, 0, height)),
        ((0, 0, height), (0, -upper, height)),
        ((0, -upper, height), (elbow, -upper, height)),
        ((elbow, -fore, height), (last, -fore, height)),
        ((last, -fore, height), (last, -wrist, height)),
        ((last, -wrist, height), (last, -wrist, height - 0.1157)),
        ((last, -wrist, height - 0.1157), (last, -wrist - 0.0922, height - 0.1157)),
    ]
    np.testing.assert_allclose(np.stack([starts[0], ends[0]], axis=1), axes, atol=1e-9)
    assert (np.diff(radii) <= 0).all()


def test_the_last_body_ends_at_the_flange():
    joints = np.random.default_rng(1).uniform(-3, 3, (20, 6))
    _, ends, _ = body_segments(CellGeometry(MODELS["UR10e"], LimitsConfig()), joints)
    np.testing.assert_allclose(ends[:, 6], forward(MODELS["UR10e"], joints)[:, :3, 3], atol=1e-12)


def test_margins_are_distances_less_radii_and_clearance():
    """By hand: a wrist over a table, a ball in front of the flange, a camera beside the base column."""
    table = Plane("table", (0.0, 0.0, -0.2), (0.0, 0.0, 2.0))
    frames = link_frames(MODELS["UR10"], UPRIGHT)
    wrist, flange, ahead = frames[5, :3, 3], frames[6, :3, 3], frames[6, :3, 2]
    ball_at = tuple(flange + 0.3 * ahead)
    camera = Capsule("camera", (0.0, 0.0, 0.1), (0.0, 0.0, 0.18), 0.04)
    geometry = CellGeometry(
        MODELS["UR10"],
        LimitsConfig(planes=(table,), clearance_m=0.03),
        solids=(camera,),
        obstacles=(Capsule("ball", ball_at, ball_at, 0.02),),
        obstacle_clearance_m=0.1,
    )
    gaps, contacts = margins(geometry, UPRIGHT)
    margin = dict(zip(contacts, gaps[0], strict=True))
    assert margin["wrist 3", "table", "plane"] == pytest.approx(min(wrist[2], flange[2]) + 0.2 - 0.045 - 0.03)
    assert margin["wrist 3", "ball", "obstacle"] == pytest.approx(0.3 - 0.02 - 0.045 - 0.1)
    assert margin["camera", "ball", "obstacle"] == pytest.approx(0.3 - 0.18 - 0.02 - 0.04 - 0.1)
    share = np.linspace(0, 1, 1001)[:, None]
    along_camera = flange + (0.1 + 0.08 * share) * ahead
    column = frames[0, :3, 3] + share * (frames[1, :3, 3] - frames[0, :3, 3])
    apart_m = np.linalg.norm(along_camera[:, None] - column[None], axis=2).min()
    assert margin["base column", "camera", "self"] == pytest.approx(apart_m - 0.09 - 0.04, abs=1e-3)


def test_the_workspace_box_holds_for_flange_and_camera():
    at = forward(MODELS["UR10"], UPRIGHT)[:3, 3]
    tight = LimitsConfig(workspace_min_m=tuple(at - 0.01), workspace_max_m=tuple(at + 0.01))
    gaps, _ = margins(CellGeometry(MODELS["UR10"], tight), UPRIGHT)
    assert gaps.min() > 0
    gaps, contacts = margins(CellGeometry(MODELS["UR10"], tight, watched_m=((0.0, 0.0, 0.2),)), UPRIGHT)
    assert gaps.min() == pytest.approx(-0.19, abs=0.01)
    assert contacts[gaps[0].argmin()].kind == "workspace"


def test_moving_points_include_what_is_watched():
    geometry = CellGeometry(MODELS["UR10"], LimitsConfig(), watched_m=((0.0, -0.06, 0.087),))
    points = moving_points(geometry, UPRIGHT[None])[0]
    T = forward(MODELS["UR10"], UPRIGHT)
    np.testing.assert_allclose(points[-1], T[:3, :3] @ [0.0, -0.06, 0.087] + T[:3, 3])
