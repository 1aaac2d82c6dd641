"""A chain learned from joints and flanges, against arms that the tests make by their own tables."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from calibrate.arms.chain import learn_chain, read_otherwise, wrong_row
from recordings.geometry import Array, difference, pose, rotation_exp
from tests.calibrate.chains import ROWS, DhArm

TILTED = pose(rotation_exp([0.0, np.radians(30), 0.0]), [0.1, 0.2, 0.3])
TOOL = pose(rotation_exp([0.3, -0.4, 0.5]), [0.05, -0.02, 0.2])


def any_arm(name: str, rng: np.random.Generator) -> DhArm:
    return DhArm(name, TILTED, TOOL, rng.uniform(-1, 1, len(ROWS[name])))


@pytest.mark.parametrize(("views", "spread_rad"), [(15, 1.0), (25, 0.3)])
@pytest.mark.parametrize("name", ROWS)
def test_an_arm_is_learned_whole_however_it_is_mounted(name: str, views: int, spread_rad: float) -> None:
    rng = np.random.default_rng(views)
    arm = any_arm(name, rng)
    joints, new = arm.postures(rng, views, spread_rad), arm.postures(rng, 100, spread_rad)
    for rounding in (1e-6, 1e-4):
        learned = learn_chain(np.round(joints / rounding) * rounding, arm.forward(joints))
        assert learned.explains
        miss = difference(learned.chain.forward(new), arm.forward(new))
        # n joints, each wrong by at most half its rounding, at a reach of about 1 m; learned as well as said
        assert np.abs(miss).max() < len(joints[0]) * rounding


def test_views_of_one_posture_and_joints_that_rest_are_learned_from() -> None:
    """Ten images at each of 15 stops; one joint is locked. Joints that all rest explain nothing."""
    arm = DhArm("seven joints")
    joints = arm.postures(np.random.default_rng(1), 15).repeat(10, axis=0)
    flanges = arm.forward(joints)
    assert learn_chain(joints, flanges).explains
    assert not learn_chain(np.zeros_like(joints), flanges, 1).explains
    joints[:, 2] = 0.1
    assert learn_chain(joints, arm.forward(joints)).explains


@pytest.mark.parametrize("name", ROWS)
def test_errors_of_links_move_the_flange_as_stated(name: str) -> None:
    """Against the same arm with a small error behind each joint: they differ by what X or Y can take."""
    rng = np.random.default_rng(3)
    arm = DhArm(name)
    joints = arm.postures(rng, 20)
    columns = learn_chain(joints, arm.forward(joints)).chain.by_links(joints)
    errors = np.zeros((len(ROWS[name]), 6))
    errors[:-1] = 1e-6 * rng.normal(size=(len(errors) - 1, 6))
    moved = difference(arm.forward(joints, errors), arm.forward(joints))
    found = np.linalg.lstsq(columns.reshape(-1, columns.shape[2]), moved.ravel(), rcond=1e-10)[0]
    np.testing.assert_allclose(columns @ found, moved, atol=1e-10)


def exchanged(q: Array) -> Array:
    return q[:, [0, 1, 2, 4, 3, *range(5, q.shape[1])]]


def with_coupling(q: Array) -> Array:
    """Joint 3 as a controller tells it that counts it from the horizontal."""
    q = q.copy()
    q[:, 2] += q[:, 1]
    return q


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("ur", np.degrees),
        ("spherical wrist", exchanged),
        ("ur", with_coupling),
        ("seven joints", with_coupling),
    ],
)
def test_wrong_joints_do_not_explain_the_flanges_and_are_read_otherwise(
    name: str, wrong: Callable[[Array], Array]
) -> None:
    rng = np.random.default_rng(5)
    arm = any_arm(name, rng)
    joints = arm.postures(rng, 15)
    flanges, told = arm.forward(joints), wrong(joints)
    assert not learn_chain(told, flanges).explains
    read = read_otherwise(told, flanges, np.full(15, True))
    np.testing.assert_allclose(read[0], joints, atol=1e-12)


def test_one_wrong_pair_is_found() -> None:
    rng = np.random.default_rng(6)
    arm = DhArm("spherical wrist")
    joints = arm.postures(rng, 15)
    flanges = arm.forward(joints)
    joints[3] = joints[4]
    learned = learn_chain(joints, flanges)
    assert not learned.explains and read_otherwise(joints, flanges, np.full(15, True)) is None
    assert wrong_row(learned, joints, flanges) == 3


def test_thousands_of_views_are_learned_from_in_bounded_time() -> None:
    arm, start = DhArm("ur"), time.process_time()
    joints = arm.postures(np.random.default_rng(8), 3000)
    flanges = arm.forward(joints)
    assert learn_chain(joints, flanges).rms[0] < 1e-9
    learned = learn_chain(joints, flanges[::-1])
    assert not learned.explains and wrong_row(learned, joints, flanges[::-1]) is None
    assert time.process_time() - start < 20


def test_a_linear_axis_is_refused_and_a_bending_arm_is_taken_with_what_is_left() -> None:
    rng = np.random.default_rng(7)
    arm = DhArm("ur")
    joints = arm.postures(rng, 25)
    sliding, bending = arm.forward(joints), arm.forward(joints)
    sliding[:, 0, 3] += 0.2 * joints[:, 0]
    reach = np.linalg.norm(bending[:, :2, 3], axis=1)
    bending[:, 2, 3] -= 2e-4 * (reach / reach.max()) ** 2
    assert not learn_chain(joints, sliding).explains
    learned = learn_chain(joints, bending)
    assert learned.explains and 1e-6 < learned.rms[0] < 2e-4
