"""An arm whose joints nobody told is judged as a typical one of its class: what is stated holds the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.arms.classes import ARM_CLASSES, ArmClass
from calibrate.handeye.arm import ArmPostures
from calibrate.handeye.assumed_arm import TOLD, assumed_postures, class_of_arm, link_sizes
from calibrate.handeye.solution import SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.results import PointError
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, difference, pose, rotation_exp
from tests.calibrate.cells import real_cell, with_flange

UR = ARM_CLASSES["universal-robots"]


def spread(rng: np.random.Generator, reach_m: float, count: int = 20) -> Array:
    """Flanges (n, 4, 4) all about, within this distance of base."""
    away = rng.normal(size=(count, 3))
    away *= (reach_m * rng.uniform(0.4, 1.0, count) / np.linalg.norm(away, axis=1))[:, None]
    away[:, 2] = np.abs(away[:, 2])
    return np.array([pose(rotation_exp(rng.normal(size=3)), p) for p in away])


@pytest.mark.parametrize("reach_m", [0.3, 0.8, 1.5, 2.5])
def test_a_typical_arm_reaches_what_was_recorded_over_its_own_axis_too(reach_m: float) -> None:
    flanges = spread(np.random.default_rng(1), reach_m)
    flanges[0, :2, 3] = 1e-3  # above base
    arm = assumed_postures(flanges)
    assert arm is not None
    assert np.abs(arm.chain.forward(arm.joints_rad) - flanges).max() < 1e-9


def test_flanges_beyond_every_arm_are_left_without_one() -> None:
    assert assumed_postures(spread(np.random.default_rng(1), 20.0)) is None


@pytest.mark.parametrize("of_class", ARM_CLASSES.values(), ids=lambda one: one.name)
def test_its_links_err_by_so_much_that_the_flange_is_as_far_off_as_in_its_class(of_class: ArmClass) -> None:
    arm = assumed_postures(spread(np.random.default_rng(2), 0.8))
    assert arm is not None
    sizes = link_sizes(arm, of_class)
    off = _drawn_errors(arm, sizes.shift_mm, sizes.turn_mrad)
    assert np.sqrt((off[:, 3:] ** 2).mean()) == pytest.approx(of_class.turn_rad, rel=0.15)
    shift_m = np.sqrt((off[:, :3] ** 2).mean())
    by_turns_alone_m = np.sqrt((_drawn_errors(arm, 0.0, sizes.turn_mrad)[:, :3] ** 2).mean())
    assert shift_m == pytest.approx(max(of_class.shift_m, by_turns_alone_m), rel=0.2)


def _drawn_errors(arm: ArmPostures, shift_mm: float, turn_mrad: float) -> Array:
    """[δt, δφ] of the flange all over the workspace, over many draws of the links' errors.

    For the shifts base is registered in each draw, as those do who measure an arm's accuracy: by the rigid
    motion that brings the measured places nearest to the told ones.
    """
    from calibrate.handeye.workspace import sample_workspace

    assert arm.table is not None
    rng = np.random.default_rng(0)
    joints = sample_workspace(arm.table, arm.joints_rad, 100)
    motion = arm.chain.by_links(joints)
    place = arm.chain.forward(joints)[:, :3, 3]
    about_m = place - place.mean(axis=0)
    sigma = 1e-3 * np.tile(np.repeat([shift_mm, turn_mrad], 3), motion.shape[2] // 6)
    registered = []
    for _ in range(300):
        off = motion @ (sigma * rng.normal(size=len(sigma)))
        shift_m = off[:, :3] - off[:, :3].mean(axis=0)
        turned = Rotation.align_vectors(about_m + shift_m, about_m)[0]
        left_m = about_m + shift_m - turned.apply(about_m)
        registered.append(np.concatenate([left_m, off[:, 3:]], axis=1))
    return np.concatenate(registered)


def test_what_was_told_of_this_very_arm_stands_before_its_class() -> None:
    views = real_cell(np.random.default_rng(4), 12).views
    assert class_of_arm(views, "", None, None).name == "unknown"
    assert class_of_arm(views, "servo", None, None) == ARM_CLASSES["servo"]
    told = class_of_arm(views, "servo", 2e-4, None)
    assert (told.name, told.shift_m, told.turn_rad) == (TOLD, 2e-4, 2e-4)
    assert class_of_arm(replace(views, robot_model="UR5e"), "", None, None) == UR


def stated(views: ViewSet, **options: object) -> PointError:
    solution = solve_views(views, SolveOptions(**options))  # type: ignore[arg-type]
    point = solution.judgement.figures.point
    assert point is not None
    return point


def test_the_parts_of_the_error_add_up_and_views_lower_it_to_its_floor() -> None:
    for mount in ("eye-in-hand", "eye-to-hand"):
        point = stated(real_cell(np.random.default_rng(4), 16, mount=mount).views)
        parts = [point.from_x_mm, point.from_arm_mm, point.from_board_lens_mm]
        assert np.sqrt(np.square(parts).sum()) == pytest.approx(point.error_mm, rel=1e-6)
        assert 0 < point.floor_mm <= point.with_more_views_mm <= point.error_mm < point.p95_mm
        assert (point.arm, point.arm_class) == ("assumed", "unknown")


def test_a_worse_class_and_a_worse_accuracy_state_more() -> None:
    views = real_cell(np.random.default_rng(4), 16).views
    plain = stated(views, arm_class="universal-robots")
    servo = stated(views, arm_class="servo")
    told = stated(views, robot_accuracy_m=5e-3)
    assert plain.error_mm < servo.error_mm
    assert plain.error_mm < told.error_mm
    assert (told.arm, told.arm_class) == ("told", "")
    assert servo.arm_class == "servo"


def test_the_covariance_of_x_holds_the_arms_mean_error_that_no_view_shows() -> None:
    """Every flange is off by the same turn and shift in base: no residual, and a fixed camera's X is off."""
    cell = real_cell(np.random.default_rng(4), 16, mount="eye-to-hand")
    off = np.array([4e-4, -3e-4, 2e-4, 2e-4, -3e-4, 3e-4])
    moved = pose(rotation_exp(off[3:]), off[:3])
    views = with_flange(cell.views, moved @ cell.views.base_from_flange)
    solution = solve_views(views, SolveOptions())
    delta = difference(cell.X, solution.matrix)
    assert delta @ np.linalg.solve(solution.covariance, delta) < solution.fit.confidence_threshold
