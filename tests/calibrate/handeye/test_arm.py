"""An arm whose residuals follow its joints is found; a good one is not accused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks.kinematics import worn_cell
from calibrate.handeye.arm import PARAMETERS
from calibrate.handeye.solve import SolveOptions, solve_views
from tests.calibrate.cells import inside

WITH = SolveOptions(holdout=False, folds=False)
WITHOUT = replace(WITH, model_arm=False)


def test_table_errors_are_found_and_coverage_comes_back():
    rng = np.random.default_rng(0)
    held = {"with": 0, "without": 0}
    for _ in range(5):
        worn = worn_cell(rng, 0.4)
        found, plain = solve_views(worn.views, WITH), solve_views(worn.views, WITHOUT)
        assert found.arm.log_bayes > 3 and found.arm.detected
        assert 0.1 < found.arm.size_mm < 1.0
        assert "arm-systematics" in {remark.code for remark in found.warnings}
        assert plain.arm is None and "arm-systematics" not in {remark.code for remark in plain.warnings}
        assert found.rejected == ()
        held["with"] += inside(found, worn.X)
        held["without"] += inside(plain, worn.X)
    assert held["with"] >= 4 and held["with"] > held["without"]


def test_a_good_arm_is_not_accused_and_costs_little():
    rng = np.random.default_rng(1)
    prices = []
    for _ in range(5):
        worn = worn_cell(rng, 0.0)
        found, plain = solve_views(worn.views, WITH), solve_views(worn.views, WITHOUT)
        assert found.arm.log_bayes < 3 and not found.arm.detected
        assert "arm-systematics" not in {remark.code for remark in found.warnings}
        prices.append(found.sigma_translation_m / plain.sigma_translation_m)
    assert 0.95 < np.mean(prices) < 1.3


def test_without_joints_the_poses_serve():
    rng = np.random.default_rng(0)
    for _ in range(2):
        worn = worn_cell(rng, 0.4)
        bare = replace(worn.views, views=tuple(replace(v, joints_rad=None) for v in worn.views))
        found = solve_views(bare, WITH)
        assert found.arm.detected
        assert inside(found, worn.X)


@pytest.mark.parametrize("model", ["unknown", "UR3"])
def test_of_an_unknown_arm_no_table_is_claimed(model):
    views = replace(worn_cell(np.random.default_rng(2), 0.4).views, robot_model=model)
    arm = solve_views(views, WITH).arm
    assert arm is None or not set(arm.errors) & set(PARAMETERS)


@pytest.mark.parametrize("options", [WITH, WITHOUT], ids=["arm", "no arm"])
@pytest.mark.parametrize("count", [9, 20])
def test_the_stated_region_is_wider_for_fewer_views_with_and_without_the_arm(count, options):
    """6·F(6, ν), ν = 3n - 5 of the n views that count: never the limit of a noise that is known exactly."""
    views = worn_cell(np.random.default_rng(2), 0.4).views.select(list(range(count)))
    solution = solve_views(views, options)
    assert (solution.arm is None) == (options is WITHOUT)
    counted = sum(1 - solution.suspects.get(index, 0.0) for index in solution.used)
    expected = 6 * stats.f.ppf(0.95, 6, 3 * counted - 5)
    assert solution.confidence_threshold == pytest.approx(expected, rel=0.03)
    assert solution.confidence_threshold > 1.04 * stats.chi2.ppf(0.95, 6)


def test_seven_views_are_too_few_for_eighteen_errors():
    views = worn_cell(np.random.default_rng(2), 0.4).views
    assert solve_views(views.select(list(range(7))), WITH).arm is None
    assert solve_views(views.select(list(range(8))), WITH).arm is not None
