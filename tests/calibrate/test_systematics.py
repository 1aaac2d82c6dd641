"""A worn arm: its errors are found, said, and no longer hidden in a sigma that is far too small."""

import numpy as np
import pytest

from benchmarks.kinematics import worn_cell
from calibrate.geometry import difference, inverse
from calibrate.kinematics import MODELS, DhDeltas, forward
from calibrate.likelihood.kinematics import kinematic_derivatives
from calibrate.solve import SolveOptions, solve_views
from tests.calibrate.cells import with_flange

AUTO = SolveOptions(holdout=False)
OFF = SolveOptions(holdout=False, kinematic_prior="off")


def squared_sigmas(solution, X):
    delta = difference(solution.matrix, X)
    return delta @ np.linalg.solve(solution.covariance, delta)


def test_table_errors_are_found_and_coverage_comes_back():
    rng = np.random.default_rng(0)
    inside_auto = inside_off = 0
    for _ in range(6):
        worn = worn_cell(rng, 0.4)
        auto, off = solve_views(worn.views, AUTO), solve_views(worn.views, OFF)
        assert auto.systematics.detected
        assert auto.systematics.prior_applied
        assert auto.systematics.worst_joint in auto.systematics.text
        assert any("follow its joints" in text for text in auto.warnings)
        assert not off.systematics.prior_applied
        assert auto.systematics.scale_mm < 1.0
        inside_auto += squared_sigmas(auto, worn.X) < auto.confidence_threshold
        inside_off += squared_sigmas(off, worn.X) < off.confidence_threshold
        assert auto.rejected == ()
    assert inside_auto >= 5
    assert inside_off <= 2


def test_the_joint_that_is_off_is_named_with_its_size_in_millimetres():
    """A forearm that is 0.8 mm longer than the table says."""
    views = worn_cell(np.random.default_rng(3), 0.0).views
    joints = np.array([view.joints_rad for view in views])
    table = MODELS["UR10"].calibrated(DhDeltas(a_m=(0.0, 0.0, 0.0008, 0.0, 0.0, 0.0)))
    error = inverse(forward(MODELS["UR10"], joints)) @ forward(table, joints)
    found = solve_views(with_flange(views, views.base_from_flange @ error), AUTO).systematics
    assert found.detected and found.worst_joint == "elbow"
    assert found.worst_joint_rms_m == pytest.approx(0.0008, rel=0.4)
    assert found.scale_mm == pytest.approx(0.8 / np.sqrt(24), rel=1.0)
    assert f"about {found.scale_mm:.2f} mm (or mrad)" in found.text
    assert f"most at the elbow ({1000 * found.worst_joint_rms_m:.2f} mm at the flange)" in found.text


def test_a_good_arm_is_not_accused():
    rng = np.random.default_rng(1)
    for _ in range(6):
        solution = solve_views(worn_cell(rng, 0.0).views, AUTO)
        assert not solution.systematics.detected
        assert not any("follow its joints" in text for text in solution.warnings)


@pytest.mark.parametrize("seed", [11, 20, 21, 38, 59])
def test_errors_that_nearly_drown_in_the_noise_are_allowed_for_though_nobody_is_accused(seed):
    """Without them the true X is up to 3 times (squared) outside the 95 % ellipsoid."""
    worn = worn_cell(np.random.default_rng(seed), 0.08)
    auto, off = solve_views(worn.views, AUTO), solve_views(worn.views, OFF)
    assert squared_sigmas(off, worn.X) > off.confidence_threshold
    assert squared_sigmas(auto, worn.X) < auto.confidence_threshold
    assert not auto.systematics.detected
    assert auto.systematics.prior_applied
    assert "are allowed for" in auto.systematics.text
    assert not any("kinematic table" in text for text in auto.warnings)


@pytest.mark.parametrize(("seed", "size_mm", "asked"), [(11, 0.08, True), (0, 0.4, False)])
def test_turned_orientations_are_asked_about_unless_the_arm_is_found_worn(seed, size_mm, asked, monkeypatch):
    """A table that is only allowed for does not explain them away."""
    monkeypatch.setattr("calibrate.profile_robust.check_frames", lambda *_: "turned")
    solution = solve_views(worn_cell(np.random.default_rng(seed), size_mm).views, AUTO)
    assert solution.systematics.prior_applied
    assert ("turned" in solution.warnings) == asked


def test_without_joints_or_with_foreign_joints_nothing_is_claimed():
    from dataclasses import replace

    views = worn_cell(np.random.default_rng(2), 0.4).views
    for changed in (
        replace(views, robot_model="unknown"),
        replace(views, robot_model="UR5"),
        replace(views, views=tuple(replace(view, joints_rad=None) for view in views)),
    ):
        assert kinematic_derivatives(changed) is None
        assert solve_views(changed, AUTO).systematics is None


def test_a_worn_arm_is_not_taken_for_bad_views():
    """19 of these views agree better than all 25, and among themselves do not show the arm's error."""
    worn = worn_cell(np.random.default_rng(41), 0.25)
    solution = solve_views(worn.views, AUTO)
    assert solution.rejected == ()
    assert solution.systematics.prior_applied
