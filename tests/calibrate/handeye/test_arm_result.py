"""The arm's table as a result: what is offered, what it brings on poses elsewhere, what is never mixed up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.scene import random_rotation
from calibrate.arms.chain import chain_of
from calibrate.arms.kinematics import MODELS, forward, with_near_axes
from calibrate.handeye.arm_table import CorrectedArm
from calibrate.handeye.placed_point import KnownErrors, PlacedPoint, Postures, farthest_tool_m
from calibrate.handeye.solution import Solution, UncorrectedArm
from calibrate.handeye.solve import solve_views
from calibrate.handeye.uncertainty import Inverse, inverse_of
from calibrate.handeye.uncorrected_arm import best_change_of_X
from calibrate.handeye.workspace import sample_around
from calibrate.pipeline.solved import Solved
from recordings.geometry import Array, difference, inverse, perturb, pose
from tests.calibrate.cells import MOUNTS, QUICK
from tests.calibrate.worn_cell import Worn, worn_cell

UR10 = MODELS["UR10"]
CHAIN = chain_of(UR10)
FACTORY = UR10.calibrated(
    a_m=(0.0, 8e-4, -6e-4, 4e-4, 0.0, 0.0),
    d_m=(0.0, 40.0, -15.0, -25.0, 0.0, 0.0),
    alpha_rad=(3e-4, 1e-5, -2e-5, 4e-4, -3e-4, 0.0),
    theta_rad=(0.0, 1e-3, -2e-3, 1e-3, 5e-4, 0.0),
)
"""Parallel axes to within 0.02 mrad, their common normals tens of metres off, as makers state them."""


@pytest.fixture(scope="module")
def worn() -> Worn:
    return worn_cell(np.random.default_rng(4), 0.4)


@pytest.fixture(scope="module")
def solved(worn: Worn) -> Solution:
    return solve_views(worn.views, replace(QUICK, folds=True))


def table_of(solution: Solution) -> CorrectedArm:
    return solution.fit.arm.result


def as_it_is(solution: Solution) -> UncorrectedArm:
    return solution.fit.arm.uncorrected


def spread(flange: Array, X: Array, C: Array) -> float:
    """rms distance of the board's origin from its mean over all poses: one place, if all is right."""
    at = (flange @ X @ C)[:, :3, 3]
    return float(np.sqrt(((at - at.mean(axis=0)) ** 2).sum(axis=1).mean()))


def test_the_table_with_its_own_x_is_best_at_new_poses(worn: Worn, solved: Solution) -> None:
    table = table_of(solved)
    assert table.offered
    nominal, corrected = forward(UR10, worn.new_joints), table.chain.forward(worn.new_joints)
    both = spread(corrected, table.result.transform.matrix, worn.new_board_poses)
    np.testing.assert_array_equal(table.result.transform.matrix, solved.matrix)
    q = np.array([view.joints_rad for view in worn.views.views])
    np.testing.assert_array_equal(table.joints_rad, np.transpose([q.min(axis=0), q.max(axis=0)]))
    uncorrected = spread(nominal, as_it_is(solved).X, worn.new_board_poses)
    assert both < 0.6 * uncorrected
    assert table.with_table_mm < 0.7 * table.without_table_mm
    figures = solved.judgement.figures
    assert figures.predicted_error_mm == figures.point.error_mm
    assert figures.point.error_mm == pytest.approx(table.without_table_mm), "by the X that is installed"
    assert figures.point.corrected_mm == table.with_table_mm
    told = Solved(worn.views, solved, ())
    np.testing.assert_array_equal(told.X, as_it_is(solved).X)
    np.testing.assert_array_equal(told.covariance(), as_it_is(solved).covariance)


def test_held_out_poses_elsewhere_say_the_same(solved: Solution) -> None:
    told = table_of(solved).held_out
    assert told is not None and told.views == 25
    assert told.with_table_mm < 0.8 * told.without_table_mm


def test_a_table_that_fails_elsewhere_is_not_offered(worn: Worn, monkeypatch: pytest.MonkeyPatch) -> None:
    worse = np.tile([[1e-3], [2e-3]], (1, 25))
    monkeypatch.setattr("calibrate.handeye.describe.held_out_elsewhere", lambda fit, joints: worse)
    assert table_of(solve_views(worn.views, replace(QUICK, folds=True))).refused == "not-better"


@pytest.mark.parametrize("stated", [True, False])
def test_flanges_of_a_factory_calibration_need_that_table(worn: Worn, stated: bool) -> None:
    """The controller's poses follow its own table: with that all is well, else nothing is offered."""
    moved = [
        replace(v, base_from_flange=forward(FACTORY, q) @ inverse(forward(UR10, q)) @ v.base_from_flange)
        for v, q in ((v, np.asarray(v.joints_rad)) for v in worn.views)
    ]
    views = replace(worn.views, views=tuple(moved), arm=FACTORY if stated else None)
    table = table_of(solve_views(views, QUICK))
    assert table.nominal_source == ("factory" if stated else "published")
    if stated:
        assert table.refused in ("", "no-evidence") and max(np.abs(table.nominal.d_m)) < 0.5
    else:
        assert table.refused == "not-nominal"


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_far_axes_are_restated_and_the_flange_stays(seed: int) -> None:
    rng = np.random.default_rng(seed)
    far = 100 * rng.normal()
    arm = UR10.calibrated(
        tuple(1e-3 * rng.normal(size=6)),
        (0.0, far, -0.7 * far, -0.3 * far, 0.0, 0.0),
        tuple(1e-5 * rng.normal(size=6)),
        (0.0, *rng.uniform(-0.5, 0.5, 3), 0.0, 0.0),
    )
    near, joints = with_near_axes(arm), rng.uniform(-3, 3, (10, 6))
    assert near.d_m[1:3] == (0.0, 0.0) and abs(near.d_m[3]) < 0.5
    np.testing.assert_allclose(forward(near, joints), forward(arm, joints), atol=1e-9)


@MOUNTS
def test_the_uncorrected_arm_gets_the_x_that_places_points_best(mount: str) -> None:
    """Against every nudge of it, by the mean of |e|² over the recorded postures and the workspace."""
    rng = np.random.default_rng(2)
    recorded = rng.uniform(-0.6, 0.6, (12, 6)) + np.array([0, -1.5, 1.5, -1.5, -1.5, 0])
    around = sample_around(CHAIN, recorded, 100)
    no_bracket = np.zeros((100, 6, 0))
    near, far = (
        Postures(CHAIN.forward(q), CHAIN.by_links(q), no_bracket[: len(q)]) for q in (recorded, around)
    )
    X = pose(random_rotation(rng), [0.05, 0.02, 0.1])
    if mount == "eye-to-hand":
        X = near.flange[0] @ X
    errors = 3e-4 * rng.normal(size=30)
    exact = KnownErrors(X, errors, np.zeros((36, 36)), np.zeros(2), 1.0)

    def missed(change: Array) -> float:
        installed = perturb(X, change)
        total = 0.0
        for x, y in [(0.0, 0.0), (0.25, 0.25), (0.25, -0.25), (-0.25, 0.25), (-0.25, -0.25)]:
            point = np.array([np.tan(x), np.tan(y), 1.0]) * 0.5
            tool_m = farthest_tool_m(mount, X, point, near.flange)
            for at, reach_m in ((near, None), (far, tool_m)):
                total += PlacedPoint.of(mount, exact, installed, point, at, reach_m).systematic()
        return total

    best = best_change_of_X(mount, X, 0.5, near, far) @ errors
    least = missed(best)
    assert least < missed(np.zeros(6))
    for nudge in 1e-4 * rng.normal(size=(20, 6)):
        assert least < missed(best + nudge)


def test_stated_covariance_of_the_corrected_flange_holds(worn: Worn, solved: Solution) -> None:
    """At poses that took no part; the true flange from the true board and camera, up to what X and Y take."""
    table = table_of(solved)
    T = CHAIN.by_links(worn.new_joints)
    sigma = np.sqrt(np.einsum("nij,jk,nik->n", T[:, :3], np.array(table.covariance)[6:, 6:], T[:, :3]))
    true = worn.new_board_poses  # camera_from_board: Y is one for all of them
    implied = inverse(worn.X @ true)
    Y = table.chain.forward(worn.new_joints) @ inverse(implied)
    off = difference(Y, np.broadcast_to(Y[0], Y.shape))[:, :3]
    assert np.median(np.linalg.norm(off - off.mean(axis=0), axis=1) / sigma) < 2.0


def test_the_quick_and_the_careful_inverse_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    A = rng.normal(size=(6, 6))
    N = np.diag([1e9, 1.0, 1e4, 1e-3, 1.0, 1.0]) @ (A @ A.T) @ np.diag([1e9, 1.0, 1e4, 1e-3, 1.0, 1.0])
    quick = inverse_of(N)
    monkeypatch.setattr("calibrate.handeye.uncertainty._WELL_DETERMINED", 1.0)
    np.testing.assert_allclose(quick, inverse_of(N), rtol=1e-6)


@pytest.mark.parametrize("N", [np.full((3, 3), np.nan), np.diag([1.0, -1.0])])
def test_what_has_no_inverse_is_said_as_such(N: Array) -> None:
    with pytest.raises(np.linalg.LinAlgError):
        inverse_of(N)


@pytest.mark.parametrize("careful_below", [1e-11, 1.0])
def test_an_inverse_keeps_a_root_and_the_determinant(
    monkeypatch: pytest.MonkeyPatch, careful_below: float
) -> None:
    monkeypatch.setattr("calibrate.handeye.uncertainty._WELL_DETERMINED", careful_below)
    rng = np.random.default_rng(3)
    A = rng.normal(size=(6, 6))
    scale = np.array([1e3, 1.0, 1e2, 1e-3, 1.0, 1.0])
    N = scale[:, None] * (A @ A.T) * scale
    found = Inverse.of(N)
    unknowns = np.arange(6.0)
    np.testing.assert_allclose(found.root @ found.root.T @ N, np.eye(6), atol=1e-6)
    np.testing.assert_allclose(found.times(N @ unknowns), unknowns, atol=1e-6)
    np.testing.assert_allclose(found.log_determinant, np.linalg.slogdet(N)[1], rtol=1e-9)
