"""The time offset of a sweep is found without a calibration, with an honest sigma."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.errors import BadViewsError, DegenerateMotionError, TooFewViewsError
from calibrate.geometry import Array, inverse, pose, random_rotation, rotation_exp
from calibrate.kinematics import MODELS, forward
from calibrate.quality.sweep import estimate_time_offset
from tests.calibrate.calling import raises_code

NOISE_RAD = 3e-4
"""Of a PnP rotation, per axis"""


def sweep(
    rng: np.random.Generator, offset_s: float, *, seconds: float = 12.0, noise_rad: float = NOISE_RAD
) -> tuple[Array, Array, Array, Array]:
    """Robot at 125 Hz, camera at 15 Hz whose clock is off; any X, any board."""

    def joints(t: Array) -> Array:
        start = np.array([0.0, -1.6, -1.5, -1.6, 1.57, 0.0])
        phase = np.linspace(0.0, 2.0, 6)
        return start + 0.25 * np.sin(0.9 * t[:, None] + phase) + 0.05 * np.sin(2.3 * t[:, None])

    X, Y = (pose(random_rotation(rng), rng.normal(size=3) * 0.2) for _ in range(2))
    robot_s, camera_s = np.arange(0, seconds, 0.008), np.arange(0.5, seconds - 0.5, 1 / 15)
    model = MODELS["UR10"]
    seen = inverse(forward(model, joints(camera_s + offset_s)) @ X) @ Y
    seen[:, :3, :3] = rotation_exp(rng.normal(0, noise_rad, (len(seen), 3))) @ seen[:, :3, :3]
    return robot_s, forward(model, joints(robot_s)), camera_s, seen


@pytest.mark.parametrize("offset_s", [-0.12, -0.004, 0.0, 0.031])
def test_the_offset_is_found_for_any_mount(offset_s: float) -> None:
    found = estimate_time_offset(*sweep(np.random.default_rng(3), offset_s))
    assert abs(found.offset_s - offset_s) < max(4 * found.sigma_s, 1e-5)
    assert found.sigma_s < 0.001 and found.rms_rad < 3 * NOISE_RAD


def test_without_noise_it_is_exact() -> None:
    found = estimate_time_offset(*sweep(np.random.default_rng(1), 0.02, noise_rad=0.0))
    assert found.offset_s == pytest.approx(0.02, abs=2e-5)


def test_sigma_is_honest() -> None:
    errors = []
    for seed in range(60):
        found = estimate_time_offset(*sweep(np.random.default_rng(seed), 0.015, seconds=8.0))
        errors.append((found.offset_s - 0.015) / found.sigma_s)
    assert 0.6 < np.std(errors) < 1.5
    assert np.mean(np.abs(errors) < 2) > 0.85


def test_wrong_poses_in_between_do_not_shift_it() -> None:
    rng = np.random.default_rng(5)
    robot_s, flange, camera_s, seen = sweep(rng, 0.02)
    for i in rng.choice(len(seen), 8, replace=False):
        seen[i, :3, :3] = random_rotation(rng)
    assert estimate_time_offset(robot_s, flange, camera_s, seen).offset_s == pytest.approx(0.02, abs=0.003)


def test_a_steady_or_resting_arm_determines_nothing() -> None:
    rng = np.random.default_rng(2)
    robot_s, flange, camera_s, seen = sweep(rng, 0.0)
    still = np.repeat(flange[:1], len(flange), axis=0)
    noise = rotation_exp(rng.normal(0, NOISE_RAD, (len(seen), 3)))
    resting = np.repeat(seen[:1], len(seen), axis=0)
    resting[:, :3, :3] = noise @ resting[:, :3, :3]
    with pytest.raises(DegenerateMotionError):
        estimate_time_offset(robot_s, still, camera_s, resting)


def test_bad_input_is_named() -> None:
    robot_s, flange, camera_s, seen = sweep(np.random.default_rng(2), 0.0)
    with raises_code(TooFewViewsError, "too-few-views", views=5):
        estimate_time_offset(robot_s, flange, camera_s[:5], seen[:5])
    with raises_code(BadViewsError, "bad-clock"):
        estimate_time_offset(robot_s[::-1], flange, camera_s, seen)
    for wrong_s in (camera_s[6], camera_s[6] - 1e-3, np.nan):  # twice the same, one back, none
        stamps_s = camera_s.copy()
        stamps_s[7] = wrong_s
        with raises_code(BadViewsError, "bad-clock"):
            estimate_time_offset(robot_s, flange, stamps_s, seen)


def test_pictures_from_before_and_after_the_robots_recording_are_passed_over() -> None:
    """By 0.2 s and more: any offset that is looked for must find the robot recorded."""
    robot_s, flange, camera_s, seen = sweep(np.random.default_rng(4), 0.02)
    inside = (robot_s > 2.0) & (robot_s < 9.0)
    found = estimate_time_offset(robot_s[inside], flange[inside], camera_s, seen)
    assert found.offset_s == pytest.approx(0.02, abs=4 * found.sigma_s)
    first_s, last_s = robot_s[inside][[0, -1]]
    assert found.pairs == ((camera_s >= first_s + 0.2) & (camera_s <= last_s - 0.2)).sum() - 1
