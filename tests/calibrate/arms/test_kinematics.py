"""Kinematics of UR arms: against published poses and an independent formulation, and as properties."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from calibrate.arms.kinematics import MODELS, RobotModel, forward, inverse_many, jacobian, singularity_measure
from recordings.geometry import Array, rotation_log, skew

UR10 = MODELS["UR10"]
NAMES = sorted(MODELS)
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Textbooks and ROS turn the base by 180° about z against the controller's base frame."""

joints = st.lists(st.floats(-3.1, 3.1), min_size=6, max_size=6).map(np.array)


def product_of_exponentials(model: RobotModel, q: Array) -> Array:
    """Lynch & Park, "Modern Robotics", example 4.5: the arm stretched out along x at zero, in the textbook's
    base. Knows nothing of Denavit-Hartenberg."""
    L1, L2 = -model.a_m[1], -model.a_m[2]
    H1, H2 = model.d_m[0], model.d_m[4]
    W1, W2 = model.d_m[3], model.d_m[5]
    home = np.array([[-1, 0, 0, L1 + L2], [0, 0, 1, W1 + W2], [0, 1, 0, H1 - H2], [0, 0, 0, 1.0]])
    axes = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [0, 0, -1], [0, 1, 0]], dtype=float)
    points = np.array(
        [[0, 0, 0], [0, 0, H1], [L1, 0, H1], [L1 + L2, 0, H1], [L1 + L2, W1, 0], [L1 + L2, 0, H1 - H2]]
    )
    T = np.eye(4)
    for axis, point, angle in zip(axes, points, q, strict=True):
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = skew(axis), -np.cross(axis, point)
        T = T @ expm(twist * angle)
    return T @ home


@pytest.mark.parametrize(
    ("name", "q", "translation_m"),
    [
        # The zero and the upright pose of UR5 and UR10, as their ROS descriptions publish them.
        ("UR5", [0, 0, 0, 0, 0, 0], [0.81725, 0.19145, -0.005491]),
        ("UR5", [0, -pi / 2, 0, -pi / 2, 0, 0], [0.0, 0.19145, 1.001059]),
        ("UR10", [0, 0, 0, 0, 0, 0], [1.1843, 0.256141, 0.0116]),
        ("UR10", [0, -pi / 2, 0, -pi / 2, 0, 0], [0.0, 0.256141, 1.4273]),
    ],
)
def test_published_poses(name: str, q: list[float], translation_m: list[float]) -> None:
    assert (HALF_TURN @ forward(MODELS[name], q))[:3, 3] == pytest.approx(translation_m, abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_forward_agrees_with_the_product_of_exponentials(name: str) -> None:
    for q in np.random.default_rng(1).uniform(-pi, pi, (20, 6)):
        expected = product_of_exponentials(MODELS[name], q)
        assert np.allclose(HALF_TURN @ forward(MODELS[name], q), expected, atol=1e-12)


@settings(max_examples=60)
@given(q=joints, name=st.sampled_from(NAMES))
def test_every_inverse_solution_reaches_the_pose_and_the_joints_are_among_them(q: Array, name: str) -> None:
    model = MODELS[name]
    T = forward(model, q)
    solutions = inverse_many(model, T[None])[1]
    assert len(solutions) >= 1 or abs(np.sin(q[4])) < 1e-8
    reached = forward(model, solutions)
    assert np.abs(reached - T).max(initial=0.0) < 1e-6
    if singularity_measure(model, q) > 1e-3:
        apart = np.abs((solutions - q + pi) % (2 * pi) - pi).max(axis=1)
        assert apart.min() < 1e-5
        assert np.all(np.abs(solutions) <= pi)


def test_a_pose_well_inside_the_reach_has_eight_different_inverses() -> None:
    solutions = inverse_many(UR10, forward(UR10, [[0.3, -1.2, 1.6, -1.0, -1.3, 0.4]]))[1]
    assert solutions.shape == (8, 6)
    apart = np.abs((solutions[:, None] - solutions[None] + pi) % (2 * pi) - pi).max(axis=2)
    assert apart[~np.eye(8, dtype=bool)].min() > 0.05


@pytest.mark.parametrize("translation_m", [[2.7, 0, 0.5], [0.7, 0, -1.6], [0.05, 0.0, 0.6]])
def test_a_pose_out_of_reach_or_on_the_shoulder_axis_has_no_inverse(translation_m: list[float]) -> None:
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = translation_m
    assert inverse_many(UR10, T[None])[1].shape == (0, 6)


@pytest.mark.parametrize("q5", [0.0, 1e-12, 1e-9, 1e-8, 1e-6, pi - 1e-9, pi])
@pytest.mark.parametrize("q3", [0.0, 1e-7, 1.6])
def test_near_singular_poses_are_reached_with_full_precision(q3: float, q5: float) -> None:
    T = forward(UR10, [0.3, -1.2, q3, -1.0, q5, 0.4])
    solutions = inverse_many(UR10, T[None])[1]
    assert len(solutions) >= 2
    assert np.abs(forward(UR10, solutions) - T).max() < 1e-7


@settings(max_examples=30)
@given(q=joints, name=st.sampled_from(NAMES))
def test_jacobian_is_the_derivative_of_forward(q: Array, name: str) -> None:
    model, step = MODELS[name], 1e-6
    numeric = np.zeros((6, 6))
    for i in range(6):
        d = np.zeros(6)
        d[i] = step
        plus, minus = forward(model, q + d), forward(model, q - d)
        numeric[:3, i] = (plus[:3, 3] - minus[:3, 3]) / (2 * step)
        numeric[3:, i] = rotation_log(plus[:3, :3] @ minus[:3, :3].T) / (2 * step)
    assert np.allclose(jacobian(model, q), numeric, atol=1e-6)


@pytest.mark.parametrize(
    "q",
    [
        [0.3, -1.2, 1.6, -1.0, 0.0, 0.4],  # wrist: joints 4 and 6 parallel
        [0.3, -1.2, 0.0, -1.0, -1.3, 0.4],  # elbow stretched
        [0.3, *np.array([-1.2, 1.6, -1.0]), pi, 0.4],  # wrist again, folded back
    ],
)
def test_singular_poses_measure_zero(q: list[float]) -> None:
    assert singularity_measure(UR10, q) < 1e-9
    assert singularity_measure(UR10, [0.3, -1.2, 1.6, -1.0, -1.3, 0.4]) > 0.05
