"""Errors of the arm's kinematic table move the flange as stated, from joints or from poses alone."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.kinematics import worn_cell
from calibrate.geometry import Array, difference, inverse, pose, rotation_exp
from calibrate.handeye.arm import PARAMETERS, by_parameters, table_motion
from calibrate.kinematics import MODELS, DhDeltas, forward, link_frames
from tests.calibrate.cells import changed

UR10 = MODELS["UR10"]


def with_error(name: str, size: float, joints: Array) -> Array:
    """(n, 4, 4) flange of an arm whose table has this one error."""
    parameter, joint = name[:-1], int(name[-1]) - 1
    if parameter == "beta":  # standard tables have no such turn: about y of the frame after the joint
        frames = link_frames(UR10, joints)
        after = frames[:, joint + 1]
        return after @ pose(rotation_exp([0, size, 0]), np.zeros(3)) @ inverse(after) @ frames[:, 6]
    field = {"a": "a_m", "d": "d_m", "alpha": "alpha_rad", "theta": "theta_rad"}[parameter]
    return forward(UR10.calibrated(DhDeltas(**{field: tuple(size * np.eye(6)[joint])})), joints)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_each_error_moves_the_flange_as_stated(seed):
    joints = np.random.default_rng(seed).uniform(-3, 3, size=(3, 6))
    exact = by_parameters(UR10, joints)
    h = 1e-6
    for place, name in enumerate(PARAMETERS):
        moved = difference(with_error(name, h, joints), with_error(name, -h, joints)) / (2 * h)
        np.testing.assert_allclose(exact[:, :, place], moved, atol=1e-6)


def test_the_errors_are_all_that_camera_and_board_do_not_take():
    """With X and the board's pose beside them, none is a combination of the others."""
    views = worn_cell(np.random.default_rng(0), 0.0).views
    motion = table_motion(views)
    F, n = views.base_from_flange, len(views)
    by_base = np.zeros((n, 6, 6))
    by_base[:] = np.eye(6)
    by_base[:, 0, 4], by_base[:, 0, 5] = F[:, 2, 3], -F[:, 1, 3]
    by_base[:, 1, 3], by_base[:, 1, 5] = -F[:, 2, 3], F[:, 0, 3]
    by_base[:, 2, 3], by_base[:, 2, 4] = F[:, 1, 3], -F[:, 0, 3]
    by_flange = np.zeros((n, 6, 6))
    by_flange[:, :3, :3] = by_flange[:, 3:, 3:] = F[:, :3, :3]
    J = np.concatenate([by_base, by_flange, motion], axis=2).reshape(6 * n, -1)
    singular = np.linalg.svd(J / np.linalg.norm(J, axis=0), compute_uv=False)
    assert singular[-1] > 1e-5 * singular[0]


def test_joints_are_read_or_else_found_in_one_branch():
    views = worn_cell(np.random.default_rng(1), 0.0).views
    read = table_motion(views)
    bare = replace(views, views=tuple(replace(view, joints_rad=None) for view in views))
    found = table_motion(bare)
    assert read is not None and found is not None and found.shape == read.shape == (25, 6, 18)
    one_missing = changed(views, [3], joints_rad=lambda _: None)
    np.testing.assert_array_equal(table_motion(one_missing), found)
    # Joints that do not lead to the flange are another arm's: the poses are believed, not they.
    foreign = changed(views, [3], joints_rad=lambda view: view.joints_rad + 0.2)
    np.testing.assert_array_equal(table_motion(foreign), found)


@pytest.mark.parametrize("model", ["unknown", "UR3"])
def test_an_unknown_or_impossible_arm_has_no_table(model):
    views = worn_cell(np.random.default_rng(1), 0.0).views
    assert table_motion(replace(views, robot_model=model)) is None
