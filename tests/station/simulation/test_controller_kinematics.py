"""The simulated arm's own kinematics: against published figures, and against the station's."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrate.arms import kinematics as station
from recordings.geometry import pose_from_vector
from station.simulation.controller.kinematics import TABLES, Rigid, forward, from_pose, to_pose

numbers = st.floats(-1.5, 1.5)


def matrix(T: Rigid) -> np.ndarray:
    return np.vstack([np.array(T).reshape(3, 4), [0, 0, 0, 1]])


@pytest.mark.parametrize("model", sorted(TABLES))
def test_both_kinematics_agree(model: str) -> None:
    for q in np.random.default_rng(3).uniform(-pi, pi, (20, 6)):
        expected = station.forward(station.MODELS[model], q)
        assert np.allclose(matrix(forward(TABLES[model], tuple(q))), expected, atol=1e-12)


@settings(max_examples=60)
@given(pose=st.tuples(*[numbers] * 6))
def test_poses_and_rotation_vectors_agree_with_geometry(pose: tuple[float, ...]) -> None:
    T = from_pose(pose)
    assert np.allclose(matrix(T), pose_from_vector(pose), atol=1e-12)
    assert to_pose(T) == pytest.approx(pose, abs=1e-9)
