"""Errors of the arm move the flange as stated; an arm that has them is found, a good one is not accused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from benchmarks.imperfect_cells import Imperfection, imperfect_cell
from benchmarks.judge.cell import Name, make
from benchmarks.judge.solver import answer
from calibrate.handeye import cell_fit, estimate
from calibrate.handeye.arm import arm_postures, flex_motion, gravity_in_flange
from calibrate.handeye.cell_fit import fit_cell
from calibrate.handeye.estimate import Estimate, MixtureParts
from calibrate.handeye.priors import LensPrior, Priors
from calibrate.handeye.solve import solve_views
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, difference, inverse, pose, rotation_exp
from recordings.schema.messages import Mount
from tests.calibrate.cells import LOW, MOUNTS, QUICK, changed, error_mm_deg, inside, with_flange
from tests.calibrate.chains import arm_cell
from tests.calibrate.worn_cell import worn_cell


@cache
def worn_views(size_mm: float) -> ViewSet:
    return worn_cell(np.random.default_rng(2), size_mm).views


def without_joints(views: ViewSet) -> ViewSet:
    return changed(views, list(range(len(views))), joints_rad=lambda _: None)


def without_arm(views: ViewSet) -> Estimate:
    return fit_cell(views, Priors(LensPrior.given(views.camera)), 0).plain


@MOUNTS
def test_a_bracket_turns_what_it_carries_by_its_compliance(mount: Mount) -> None:
    cell, compliance = arm_cell("ur", mount, 0.0, 1), 1e-5 * np.random.default_rng(1).normal(size=(3, 3))
    F, held = cell.views.base_from_flange, cell.X if mount == "eye-in-hand" else cell.Y
    bent = pose(rotation_exp(gravity_in_flange(F) @ compliance.T), np.zeros((len(F), 3))) @ held
    found = flex_motion(F, np.zeros(3)) @ compliance.ravel()
    np.testing.assert_allclose(found, difference(F @ bent @ inverse(held), F), atol=1e-9)


@MOUNTS
def test_a_bracket_that_bends_leaves_the_truth_in_the_region(mount: Mount) -> None:
    bends = Imperfection(flex_rad=float(np.radians(0.1)))
    cell = imperfect_cell(np.random.default_rng(2), mount, bends, noise=LOW)
    solution = solve_views(cell.views, QUICK)
    assert inside(solution, cell.X)
    assert error_mm_deg(solution.fit.parent_from_child.matrix, cell.X)[0] < 0.25


def test_table_errors_are_found_and_coverage_comes_back():
    rng = np.random.default_rng(0)
    held = {"with": 0, "without": 0}
    for _ in range(2):
        worn = worn_cell(rng, 0.4)
        found = solve_views(worn.views, QUICK)
        assert found.fit.arm.stated.log_bayes > 3 and found.fit.arm.stated.applied
        shift_mm = found.fit.arm.stated.size_mm
        turn_mrad = found.fit.arm.stated.size_mrad
        assert 0.1 < shift_mm < 1.0 and 0.1 < turn_mrad < 1.0 and shift_mm != turn_mrad
        assert "arm-systematics" in {remark.code for remark in found.judgement.warnings}
        assert found.evidence.views.rejected == []
        held["with"] += inside(found, worn.X)
        plain = without_arm(worn.views)
        off = difference(plain.state.X, worn.X)
        held["without"] += off @ np.linalg.solve(plain.covariance[:6, :6], off) <= plain.threshold
    assert held["with"] == 2 > held["without"]


def test_a_good_arm_is_not_accused_and_costs_little():
    rng = np.random.default_rng(1)
    prices = []
    for _ in range(2):
        worn = worn_cell(rng, 0.0)
        found = solve_views(worn.views, QUICK)
        assert found.fit.arm.stated.log_bayes < 3 and not found.fit.arm.stated.applied
        assert found.fit.arm.result.refused == "no-evidence"
        assert "arm-systematics" not in {remark.code for remark in found.judgement.warnings}
        plain_m = np.sqrt(np.trace(without_arm(worn.views).covariance[:3, :3]))
        prices.append(found.sigma_translation_m / plain_m)
    assert 0.95 < np.mean(prices) < 1.3


def test_without_joints_the_poses_serve():
    worn = worn_cell(np.random.default_rng(0), 0.4)
    found = solve_views(without_joints(worn.views), QUICK)
    assert found.fit.arm.stated.applied and found.fit.arm.result.refused == "no-joints"
    assert inside(found, worn.X)


@pytest.mark.parametrize("count", [8, 7], ids=["arm", "too few for the arm"])
def test_the_stated_region_is_wider_for_fewer_views_with_and_without_the_arm(count):
    """6·F(6, ν), ν = 3n - 6 of the n views that count: never the limit of a noise that is known exactly."""
    solution = solve_views(worn_views(0.4).select(list(range(count))), QUICK)
    assert (solution.fit.arm is None) == (count == 7)
    counted = sum(1 - solution.evidence.suspects.get(index, 0.0) for index in solution.evidence.views.used)
    expected = 6 * stats.f.ppf(0.95, 6, 3 * counted - 6)
    assert solution.fit.confidence_threshold == pytest.approx(expected, rel=0.03)
    assert solution.fit.confidence_threshold > 1.04 * stats.chi2.ppf(0.95, 6)


def test_the_region_of_an_average_holds_95_percent_of_it():
    """Of normal distributions of several widths: more lies far out than of one with their mean variance."""
    views = worn_views(0.3)
    found = fit_cell(views, Priors(LensPrior.given(views.camera)), 0)
    assert found.estimate.scales.arm_error_sigma[0] > 0.1 > found.estimate.scales.arm_error_sigma[-1], (
        "the bracket is rigid"
    )
    chances, widths = np.array([0.5, 0.3, 0.2]), np.array([0.2, 0.8, 3.3])
    average = replace(found.estimate, mixture=MixtureParts(chances, widths))
    rng, n = np.random.default_rng(0), 200_000
    freedom = 3 * average.chances[:, 0].sum() - 6
    drawn = rng.choice(widths, n, p=chances) * 6 * rng.f(6, freedom, n)
    assert np.mean(drawn <= average.threshold) == pytest.approx(0.95, abs=0.002)
    assert average.threshold > 1.5 * replace(average, mixture=MixtureParts()).threshold


def test_noise_and_steps_are_those_of_the_fit_that_is_reported(monkeypatch):
    views = worn_views(1.0)
    found = fit_cell(views, Priors(LensPrior.given(views.camera)), 0)
    reported, plain = (fit.noise_parts / fit.noise_parts.sum() for fit in (found.estimate, found.plain))
    assert reported[1:].sum() < 0.8 * plain[1:].sum(), "the table explains what was taken for noise"
    assert found.estimate.converged
    monkeypatch.setattr(estimate, "MAX_STEPS", 2)
    assert "not-converged" in {remark.code for remark in solve_views(views, QUICK).judgement.warnings}


@pytest.mark.parametrize("failing", [{39}, {63}, {39, 63}], ids=["links", "flange", "both"])
def test_a_fit_of_errors_that_fails_is_said_and_does_not_cost_the_other(failing, monkeypatch):
    fits = cell_fit.estimate_with_arm_errors

    def fails(observed, *rest):
        if observed.by_arm_errors.shape[2] in failing:
            raise np.linalg.LinAlgError("singular")
        return fits(observed, *rest)

    monkeypatch.setattr(cell_fit, "estimate_with_arm_errors", fails)
    found = solve_views(worn_views(0.4), QUICK)
    assert (found.fit.arm is None) == (found.fit.posterior.arm is None) == (39 in failing)
    assert (found.fit.posterior.flange_extent_m is None) == (63 in failing)
    assert (found.fit.posterior.level is None) == (len(failing) == 2)
    assert found.fit.posterior.without_joints is None
    assert "arm-not-fitted" in {remark.code for remark in found.judgement.warnings}


def motion_of(views: ViewSet) -> Array:
    arm, _ = arm_postures(views, np.full(len(views), True))
    return arm.chain.by_links(arm.joints_rad)


def test_joints_are_read_or_else_found_in_one_branch():
    views = worn_views(0.0).select(list(range(10)))
    read, found = motion_of(views), motion_of(without_joints(views))
    assert read is not None and found is not None and found.shape == read.shape == (10, 6, 30)
    one_missing = changed(views, [3], joints_rad=lambda _: None)
    np.testing.assert_array_equal(motion_of(one_missing), found)
    # Joints that do not lead to the flange are another arm's: the poses are believed, not they.
    foreign = changed(views, [3], joints_rad=lambda view: view.joints_rad + 0.2)
    np.testing.assert_array_equal(motion_of(foreign), found)


@pytest.mark.parametrize("model", ["unknown", "UR3"])
def test_an_unknown_or_impossible_arm_is_learned_from_its_joints_alone(model):
    views = replace(worn_views(0.0), robot_model=model)
    every = np.full(len(views), True)
    arm, note = arm_postures(views, every)
    assert arm.table is None and not note
    assert arm_postures(without_joints(views), every) == (None, "")
    assert arm_postures(changed(views, [3], joints_rad=lambda _: None), every)[1]


@pytest.mark.parametrize(
    ("name", "mount"), [("spherical wrist", "eye-in-hand"), ("seven joints", "eye-to-hand")]
)
def test_an_arm_nobody_described_is_honest_and_better_by_its_joints(name, mount):
    """Links off by 0.3 mm and mrad, 2 cells each; `benchmarks/results/any_arm.md` has more."""
    covered, errors = [], []
    for seed in range(3, 5):
        cell = arm_cell(name, mount, 0.3, seed)
        solved = [solve_views(views, QUICK) for views in (cell.views, without_joints(cell.views))]
        covered.append(inside(solved[0], cell.X))
        errors.append([error_mm_deg(solution.matrix, cell.X)[0] for solution in solved])
        arm = solved[0].fit.arm
        assert arm.stated.applied and arm.uncorrected is not None
    with_joints, without = np.sqrt(np.mean(np.square(errors), axis=0))
    assert all(covered) and with_joints < 0.8 * without


def test_wrong_poses_cost_no_more_than_their_views():
    """Two exchanged, one ten metres away: neither is the arm forgotten nor the stated error larger."""
    cell = arm_cell("spherical wrist", "eye-to-hand", 0.3, 3)
    flange = cell.views.base_from_flange
    flange[[4, 11]], flange[7, 0, 3] = flange[[11, 4]], 10.0
    spoilt, good = with_flange(cell.views, flange), [i for i in range(25) if i not in (4, 7, 11)]
    assert inside(solution := solve_views(spoilt, QUICK), cell.X) and solution.fit.arm.stated.applied
    spoilt, sound = (solve_views(without_joints(views), QUICK) for views in (spoilt, cell.views.select(good)))
    assert spoilt.sigma_translation_m == pytest.approx(sound.sigma_translation_m, rel=0.1)
    extents_m = [solution.fit.posterior.flange_extent_m for solution in (spoilt, sound)]
    assert extents_m[0] == pytest.approx(extents_m[1], rel=1e-3)


@MOUNTS
def test_an_arm_without_joints_is_honest_by_its_class_and_by_its_stated_accuracy(mount):
    """Its flange is off by about 0.6 mm and mrad in each direction, nearly the same in all views."""
    for seed in range(2):
        cell = arm_cell("spherical wrist", mount, 0.3, seed, joints=False)
        for accuracy_m, arm in ((6e-4, "told"), (None, "assumed")):
            solution = solve_views(cell.views, replace(QUICK, robot_accuracy_m=accuracy_m))
            figures = solution.judgement.figures
            assert figures.point.arm == arm
            assert sum(figures.error_shares.values()) == pytest.approx(1.0)
            assert inside(solution, cell.X)


@MOUNTS
def test_where_no_arm_reaches_a_stated_error_of_orientation_turns_the_flange_about_itself(mount):
    """What it adds to the covariance of X is what turns of all flanges by so much would do to X."""
    cell = arm_cell("spherical wrist", mount, 0.3, 0, joints=False)
    far = pose(np.eye(3), [30.0, 0.0, 0.0])
    views = with_flange(cell.views, far @ cell.views.base_from_flange)
    bare, stated = (
        solve_views(views, replace(QUICK, robot_accuracy_m=1e-9, robot_accuracy_rad=turn_rad))
        for turn_rad in (1e-9, 2e-3)
    )
    X = stated.matrix
    pivot = np.eye(4)
    if mount == "eye-to-hand":
        used = stated.evidence.views.used
        pivot[:3, 3] = views.base_from_flange[used, :3, 3].mean(axis=0)
    step_rad = 1e-6
    moved = []
    for axis in range(3):
        turn = pose(rotation_exp(step_rad * np.eye(3)[axis]), np.zeros(3))
        moved.append(difference(pivot @ turn @ inverse(pivot) @ X, X) / step_rad)
    J = np.array(moved).T
    np.testing.assert_allclose(
        stated.covariance - bare.covariance, (2e-3) ** 2 * J @ J.T, rtol=1e-3, atol=1e-11
    )


def test_sizes_at_which_noise_and_errors_change_places_do_not_undo_the_fit():
    assert solve_views(arm_cell("spherical wrist", "eye-in-hand", 0.3, 2).views, QUICK).fit.arm is not None


def test_an_arm_whose_errors_would_reject_nearly_every_view_is_solved_without_them():
    """A servo arm, eye-to-hand, with joints: its likeliest links would leave too few views for any X."""
    found = answer(make(Name("clean", "servo arm", "eye-to-hand", joints=True, draw=0, seed=0)))
    assert not found.refused.startswith("crash")
