"""Postures at which the error "elsewhere in the workspace" is stated."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.arms.chain import chain_of
from calibrate.arms.kinematics import MODELS
from calibrate.handeye.workspace import sample_around
from recordings.geometry import Array

CHAIN = chain_of(MODELS["UR10"])
HOME = np.array([-1.6, -1.7, 2.0, -1.9, -1.57, 0.0])


def recorded(spread_rad: float = 0.3) -> Array:
    return HOME + np.random.default_rng(4).uniform(-spread_rad, spread_rad, (12, 6))


def test_the_first_joint_is_anywhere_and_the_others_half_a_radian_beyond_what_was_recorded() -> None:
    joints = recorded()
    around = sample_around(CHAIN, joints, 2000)
    assert np.ptp(around[:, 0]) == pytest.approx(2 * np.pi, abs=0.05)
    assert around[:, 1:].min(axis=0) == pytest.approx(joints[:, 1:].min(axis=0) - 0.5, abs=0.02)
    assert around[:, 1:].max(axis=0) == pytest.approx(joints[:, 1:].max(axis=0) + 0.5, abs=0.02)


def test_the_flange_stays_above_the_foot_or_where_it_was_recorded() -> None:
    standing = recorded()
    assert CHAIN.forward(sample_around(CHAIN, standing))[:, 2, 3].min() >= 0.0
    below = recorded()
    below[:, 1] += 2.2
    lowest = CHAIN.forward(below)[:, 2, 3].min()
    assert lowest < 0.0
    assert CHAIN.forward(sample_around(CHAIN, below))[:, 2, 3].min() >= lowest


def test_angles_that_jump_by_a_whole_turn_are_the_same_postures() -> None:
    joints = recorded()
    jumped = joints.copy()
    jumped[::2, 3] += 2 * np.pi
    np.testing.assert_allclose(
        CHAIN.forward(sample_around(CHAIN, joints)), CHAIN.forward(sample_around(CHAIN, jumped)), atol=1e-9
    )
