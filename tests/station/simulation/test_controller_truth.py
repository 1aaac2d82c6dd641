"""The truth of the simulated arm: by host time, with its real lengths and its repeatability."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS
from calibrate.arms.kinematics import forward as station_forward
from recordings.geometry import perturb

Q = (0.3, -1.2, 1.6, -1.0, -1.3, 0.4)


def differ(of: str, *columns: tuple[float, ...]) -> dict[str, tuple[float, ...]]:
    names = ("a_m", "d_m", "alpha_rad", "theta_rad")
    return {f"{of}_{name}": column for name, column in zip(names, columns, strict=True)}


def test_poses_follow_the_factory_calibration_and_the_true_flange_its_errors_and_the_miss(stepped) -> None:
    far = (
        (0.0, 5e-4, 0, 0, 0, 0),
        (0, 0.6, -0.2, -0.4, 0, 0),
        (0, 1e-4, 2e-4, 0, 0, 0),
        (0, 1e-3, 0, 0, 0, 0),
    )
    errors = ((0, 1e-3, 0, 0, 0, 0), (0, 0, 0, 2e-3, 0, 0), (1e-3, 0, 0, 0, 0, 0), (0, 0, 2e-3, 0, 0, 0))
    made = stepped(**differ("factory", *far), **differ("dh_delta", *errors))
    made.run(0.1)
    own = MODELS["UR10"].calibrated(*far)
    reported = made.robot.outputs.vector("actual_TCP_pose")[:3]
    assert reported == pytest.approx(station_forward(own, made.robot.arm.actual)[:3, 3], abs=1e-12)
    miss = (1e-4, -2e-4, 3e-4, 1e-3, 2e-3, -1e-3)
    flange = np.array(made.robot.true_flange(Q, miss)).reshape(3, 4)
    expected = perturb(station_forward(own.calibrated(*errors), Q), np.array(miss))
    assert np.allclose(flange, expected[:3], atol=1e-12)


def test_the_misses_have_the_sigma_they_were_asked_for_and_repeat_with_the_seed(stepped) -> None:
    draws = np.array(
        [stepped(robot_sigma_m=1e-3, robot_sigma_rad=2e-3, seed=s).robot.arm.miss for s in range(400)]
    )
    assert draws[:, :3].std() == pytest.approx(1e-3, rel=0.15)
    assert draws[:, 3:].std() == pytest.approx(2e-3, rel=0.15)
    first, second = (stepped(robot_sigma_m=1e-3, seed=5).robot.arm.miss for _ in range(2))
    assert first == second
