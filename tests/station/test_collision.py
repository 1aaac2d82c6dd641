"""Solids and distances against a brute-force oracle and postures whose answer is plain."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrate.geometry import pose, rotation_exp
from calibrate.kinematics import MODELS, forward
from station.collision import CellGeometry, body_segments, margins, moving_points, plate, segment_distance
from station.config import Capsule, LimitsConfig, Plane

UPRIGHT = np.deg2rad([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])
coordinate = st.floats(-1, 1)
point = st.tuples(coordinate, coordinate, coordinate)


@settings(max_examples=80, deadline=None)
@given(point, point, point, point)
def test_segment_distance_is_the_smallest_over_all_pairs_of_points(a0, a1, b0, b1):
    a0, a1, b0, b1 = (np.array(p) for p in (a0, a1, b0, b1))
    share = np.linspace(0, 1, 101)[:, None]
    sampled = np.linalg.norm((a0 + share * (a1 - a0))[:, None] - (b0 + share * (b1 - b0))[None], axis=2).min()
    exact = float(segment_distance(a0, a1, b0, b1))
    assert exact <= sampled + 1e-5  # nearly parallel segments: exact to the angle that counts as parallel
    assert exact >= sampled - 0.01 * (np.linalg.norm(a1 - a0) + np.linalg.norm(b1 - b0)) - 1e-9


@pytest.mark.parametrize("name", sorted(MODELS))
def test_an_arm_at_ease_touches_nothing_of_itself(name):
    gaps, labels = margins(CellGeometry(MODELS[name], LimitsConfig()), UPRIGHT)
    assert gaps.min() > 0, labels[gaps[0].argmin()]


def test_a_folded_wrist_runs_into_the_forearm():
    camera = Capsule("camera", (0.0, 0.0, 0.1), (0.0, 0.0, 0.18), 0.04)
    geometry = CellGeometry(MODELS["UR10"], LimitsConfig(), solids=(camera,))
    folded = np.deg2rad([0.0, -90.0, -90.0, 45.0, -135.0, 0.0])
    gaps, labels = margins(geometry, np.array([UPRIGHT, folded]))
    assert gaps[0].min() > 0
    assert gaps[1].min() < 0
    assert labels[gaps[1].argmin()] == "forearm against camera"


def test_the_last_body_ends_at_the_flange():
    joints = np.random.default_rng(1).uniform(-3, 3, (20, 6))
    _, ends, _ = body_segments(CellGeometry(MODELS["UR10e"], LimitsConfig()), joints)
    np.testing.assert_allclose(ends[:, 6], forward(MODELS["UR10e"], joints)[:, :3, 3], atol=1e-12)


def test_a_plane_is_named_with_the_body_that_breaks_it():
    table = Plane("table", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    geometry = CellGeometry(MODELS["UR10"], LimitsConfig(planes=(table,)))
    low = np.deg2rad([0.0, -10.0, 40.0, -120.0, -90.0, 0.0])
    gaps, labels = margins(geometry, np.array([UPRIGHT, low]))
    broken = {label for label, gap in zip(labels, gaps[1], strict=True) if gap < 0}
    assert gaps[0].min() > 0
    assert "forearm against table" in broken
    height = body_segments(geometry, UPRIGHT[None])[1][0, 6, 2]
    wrist = gaps[0][labels.index("wrist 3 against table")]
    assert wrist == pytest.approx(height - 0.045 - 0.03, abs=0.1)


def test_the_workspace_box_holds_for_flange_and_camera():
    at = forward(MODELS["UR10"], UPRIGHT)[:3, 3]
    tight = LimitsConfig(workspace_min_m=tuple(at - 0.01), workspace_max_m=tuple(at + 0.01))
    gaps, _ = margins(CellGeometry(MODELS["UR10"], tight), UPRIGHT)
    assert gaps.min() > 0
    gaps, labels = margins(CellGeometry(MODELS["UR10"], tight, watched_m=((0.0, 0.0, 0.2),)), UPRIGHT)
    assert gaps.min() == pytest.approx(-0.19, abs=0.01)
    assert "workspace" in labels[gaps[0].argmin()]


def test_a_plate_covers_its_whole_area():
    frame = pose(rotation_exp([0.3, -0.2, 0.9]), [0.5, 0.1, 0.2])
    rods = plate("board", frame, np.array([-0.05, -0.02]), np.array([0.2, 0.15]))
    flat = np.random.default_rng(0).uniform([-0.05, -0.02, 0], [0.2, 0.15, 1e-12], (300, 3))
    placed = flat @ frame[:3, :3].T + frame[:3, 3]
    reach = [
        segment_distance(placed, placed, np.array(r.from_m), np.array(r.to_m)) - r.radius_m for r in rods
    ]
    assert np.min(reach, axis=0).max() <= 1e-9


def test_moving_points_include_what_is_watched():
    geometry = CellGeometry(MODELS["UR10"], LimitsConfig(), watched_m=((0.0, -0.06, 0.087),))
    points = moving_points(geometry, UPRIGHT[None])[0]
    T = forward(MODELS["UR10"], UPRIGHT)
    np.testing.assert_allclose(points[-1], T[:3, :3] @ [0.0, -0.06, 0.087] + T[:3, 3])
