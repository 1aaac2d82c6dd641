"""The simulated arm's own kinematics: against published figures, and against the station's."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrate import kinematics as station
from calibrate.geometry import pose_from_rotvec
from station.simulation.controller.kinematics import (
    TABLES,
    Rigid,
    compose,
    forward,
    from_pose,
    inverse_all,
    inverse_nearest,
    invert,
    to_pose,
)

joints = st.tuples(*[st.floats(-3.1, 3.1)] * 6)
numbers = st.floats(-1.5, 1.5)


def matrix(T: Rigid) -> np.ndarray:
    return np.vstack([np.array(T).reshape(3, 4), [0, 0, 0, 1]])


@pytest.mark.parametrize("model", sorted(TABLES))
def test_both_kinematics_agree(model: str) -> None:
    for q in np.random.default_rng(3).uniform(-pi, pi, (20, 6)):
        expected = station.forward(station.MODELS[model], q)
        assert np.allclose(matrix(forward(TABLES[model], tuple(q))), expected, atol=1e-12)


@settings(max_examples=50)
@given(q=joints, model=st.sampled_from(sorted(TABLES)))
def test_inverses_reach_the_pose_and_agree_in_number(q: tuple[float, ...], model: str) -> None:
    T = forward(TABLES[model], q)
    solutions = inverse_all(TABLES[model], T)
    for solution in solutions:
        assert np.allclose(forward(TABLES[model], solution), T, atol=1e-6)
    if station.singularity_measure(station.MODELS[model], q) > 1e-2:
        assert len(solutions) == len(station.inverse_all(station.MODELS[model], matrix(T)))
        nearest = inverse_nearest(TABLES[model], T, q)
        assert nearest == pytest.approx(q, abs=1e-6)


@pytest.mark.parametrize(("q1", "near"), [(0.3, 6.2), (-0.3, -6.2)])
def test_the_nearest_inverse_stays_within_a_turn_either_way(q1: float, near: float) -> None:
    """q1 ± 2π would be nearest, but no joint turns that far."""
    q = (-1.2, 1.6, -1.0, -1.3, 0.4)
    T = forward(TABLES["UR10"], (q1, *q))
    found = inverse_nearest(TABLES["UR10"], T, (near, *q))
    assert found is not None and max(map(abs, found)) <= 2 * pi
    assert forward(TABLES["UR10"], found) == pytest.approx(T, abs=1e-9)


@settings(max_examples=60)
@given(pose=st.tuples(*[numbers] * 6))
def test_poses_and_rotation_vectors_agree_with_geometry(pose: tuple[float, ...]) -> None:
    T = from_pose(pose)
    assert np.allclose(matrix(T), pose_from_rotvec(pose[:3], pose[3:]), atol=1e-12)
    assert to_pose(T) == pytest.approx(pose, abs=1e-9)
    assert compose(T, invert(T)) == pytest.approx((1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0), abs=1e-12)
