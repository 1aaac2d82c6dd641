"""What anyone may rely on about frames and rotations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.scene import random_rotation
from recordings import geometry as g

vectors = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)
deltas = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(np.array)


def test_chains_touch_or_raise() -> None:
    base_from_flange = g.Transform("base", "flange", g.pose_from_vector([0.1, 0.2, 0.3, 0.1, 0, 0.4]))
    flange_from_camera = g.Transform("flange", "camera", g.pose_from_vector([0, 0, 0.05, 0, 1, 0]))
    chained = base_from_flange @ flange_from_camera
    assert (chained.parent, chained.child) == ("base", "camera")
    point = np.array([0.3, -0.2, 1.0])
    np.testing.assert_allclose(
        chained.apply(point), base_from_flange.apply(flange_from_camera.apply(point)), atol=1e-15
    )
    with pytest.raises(g.FrameMismatchError):
        flange_from_camera @ base_from_flange


def test_a_mirror_image_is_no_transform() -> None:
    with pytest.raises(ValueError):
        g.Transform("base", "flange", np.diag([1.0, 1.0, -1.0, 1.0]))


@given(vectors, deltas)
@settings(max_examples=50)
def test_difference_undoes_perturb(v: np.ndarray, delta: np.ndarray) -> None:
    reference = g.pose(g.rotation_exp(v), v[::-1])
    np.testing.assert_allclose(g.difference(g.perturb(reference, delta), reference), delta, atol=1e-9)


@given(vectors, vectors)
@settings(max_examples=50)
def test_inverse_and_quaternion_round_trip(t: np.ndarray, v: np.ndarray) -> None:
    T = g.pose(g.rotation_exp(v), t)
    np.testing.assert_allclose(g.inverse(T) @ T, np.eye(4), atol=1e-12)
    q = g.quaternion_from_matrix(T[:3, :3])
    assert q[3] >= 0
    np.testing.assert_allclose(g.pose_from_quaternion(t, q), T, atol=1e-12)


@pytest.mark.parametrize("wrong", [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0), (0.0, np.inf, 0.0, 1.0)])
def test_what_is_no_rotation_does_not_become_the_identity(wrong: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="quaternion"):
        g.matrix_from_quaternion(wrong)
    with pytest.raises(ValueError, match="quaternion"):
        g.pose_from_quaternion((0.0, 0.0, 0.0), [(0.0, 0.0, 0.0, 1.0), wrong])


def test_quaternion_order_is_x_y_z_w() -> None:
    R = g.matrix_from_quaternion([0, 0, 2, 2])
    np.testing.assert_allclose(R @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_projection_gives_the_nearest_rotation() -> None:
    rng = np.random.default_rng(1)
    R = random_rotation(rng)
    noisy = R + 0.05 * rng.normal(size=(3, 3))
    best = g.project_to_rotation(noisy)
    assert np.linalg.det(best) > 0
    rivals = [g.rotation_exp(0.02 * rng.normal(size=3)) @ best for _ in range(200)]
    assert all(np.linalg.norm(noisy - best) <= np.linalg.norm(noisy - r) for r in rivals)


def test_logarithms_are_scipys_near_and_far_and_a_mirror_is_refused() -> None:
    rng = np.random.default_rng(3)
    for angle in (0.0, 1e-12, 1e-6, 0.3, 2.9, np.pi - 1e-9):
        axes = rng.normal(size=(200, 3))
        vectors = axes / np.linalg.norm(axes, axis=1, keepdims=True) * angle
        R = Rotation.from_rotvec(vectors).as_matrix()
        np.testing.assert_allclose(g.rotation_exp(vectors), R, atol=2e-15)
        np.testing.assert_allclose(g.rotation_log(R), vectors, atol=2e-15)
    almost = R + rng.normal(size=R.shape) * 1e-5
    np.testing.assert_allclose(g.rotation_log(almost), Rotation.from_matrix(almost).as_rotvec(), atol=1e-13)
    with pytest.raises(ValueError):
        g.rotation_log(-R)
