"""The exact elimination of the board poses against one dense least-squares problem of the same posterior."""

from dataclasses import replace

import numpy as np
import pytest

from calibrate.handeye.cell_state import CellState, Layout, flange_residuals
from calibrate.handeye.linear import Linear
from calibrate.handeye.noise_scales import MeasurementNoise, Scales
from calibrate.handeye.priors import BoardTolerance, LensPrior, Priors
from calibrate.handeye.reprojection import corner_residuals
from calibrate.views.view_set import observe_views
from recordings.geometry import perturb
from tests.calibrate.cells import LENSES, MID, MOUNTS, changed, make_cell, real_cell

ONE_CLASS = np.array([1.0, 1e-300, 1e-300, 1e-300])
VIEWS = 5


def setting(mount, with_arm_errors):
    """A state a little off its optimum; one view has fewer corners than the others."""
    rng = np.random.default_rng(3)
    camera = LENSES["plumb_bob"]
    cell = real_cell(rng, VIEWS, MID, mount=mount, camera=camera)
    views = changed(cell.views, [2], corners=lambda v: v.corners.part(slice(25)))
    observed = observe_views(views)
    state = CellState(
        perturb(cell.X, 1e-3 * rng.normal(size=6)),
        perturb(cell.Y, 1e-3 * rng.normal(size=6)),
        perturb(views.camera_from_board, 1e-4 * rng.normal(size=(VIEWS, 6))),
        camera,
        1e-4 * rng.normal(size=5),
        1e-4 * rng.normal(size=3 * with_arm_errors),
    )
    if with_arm_errors:
        observed = replace(observed, by_arm_errors=rng.normal(size=(VIEWS, 6, 3)))
    return observed, state


def differences(observed, state):
    """Corner residuals (n, 2k) and flange residuals (n, 6), and their derivatives by all unknowns."""
    size = Layout.of(state).size
    count = size + 6 * VIEWS

    def both(step):
        at = state.moved(step[:size], step[size:].reshape(VIEWS, 6))
        pixels = -corner_residuals(observed, at.camera, at.C, at.shape)
        return pixels.reshape(VIEWS, -1), flange_residuals(observed, at)

    h = np.full(count, 1e-6)
    h[Layout.of(state).lens] = [1e-3] * 4 + [1e-4] * 5
    pairs = [(both(d), both(-d), 2 * d.sum()) for d in np.diag(h)]
    by = [np.stack([(a[part] - b[part]) / w for a, b, w in pairs], axis=-1) for part in (0, 1)]
    return (*both(np.zeros(count)), *by, size)


def true_state(cell):
    return CellState(cell.X, cell.Y, cell.views.camera_from_board, cell.camera, np.zeros(5), np.zeros(0))


@MOUNTS
@pytest.mark.parametrize("with_arm_errors", [False, True])
def test_elimination_equals_the_dense_solution(mount, with_arm_errors):
    observed, state = setting(mount, with_arm_errors)
    rng = np.random.default_rng(0)
    weights = rng.uniform(0.3, 1.0, observed.present.shape) * observed.present
    scales = Scales(np.array([3e-4, 5e-4]), 0.5, 0.2, 0.1, ONE_CLASS)
    linear = Linear.at(observed, state, weights, information=1.0)
    priors = Priors(LensPrior.given(state.camera), BoardTolerance())
    prior = priors.linearise(state, 1.0)
    solved = linear.solve(prior, scales, "nothing")

    r, e, by_r, by_e, size = differences(observed, state)
    root = np.sqrt(np.repeat(weights, 2, axis=1))
    rows, right = [], []
    for i in range(VIEWS):
        # The corners' noise: tau along what the view's own board pose can move, lambda along all else.
        white = root[i][:, None] * by_r[i]
        Q, _ = np.linalg.qr(white[:, size + 6 * i : size + 6 * i + 6])
        shaped = np.eye(len(root[i])) / scales.lambda_px + Q @ Q.T * (
            1 / scales.tau_px - 1 / scales.lambda_px
        )
        rows.append(shaped @ white)
        right.append(shaped @ (root[i] * r[i]))
        robot = np.repeat(1 / scales.robot, 3)
        rows.append(robot[:, None] * by_e[i])
        right.append(robot * e[i])
    J, residual = np.concatenate(rows), np.concatenate(right)
    N = J.T @ J
    N[:size, :size] += prior.N
    b = -J.T @ residual
    b[:size] += prior.right
    scale = 1 / np.sqrt(np.diag(N))
    covariance = np.linalg.inv(N * np.outer(scale, scale)) * np.outer(scale, scale)
    step = covariance @ b
    sigma = np.sqrt(np.diag(covariance))
    ours = np.linalg.inv(solved.precision)
    np.testing.assert_allclose(solved.step / sigma[:size], step[:size] / sigma[:size], atol=1e-3)
    np.testing.assert_allclose(
        linear.board_step(solved).ravel() / sigma[size:], step[size:] / sigma[size:], atol=1e-3
    )
    unit = np.outer(sigma[:size], sigma[:size])
    np.testing.assert_allclose(ours / unit, covariance[:size, :size] / unit, atol=1e-3)


def test_noise_scales_come_out_as_they_went_in():
    """Mean over cells: plain residual scatter would be far too small for the robot."""
    found = []
    for seed in range(6):
        cell = make_cell(np.random.default_rng(seed), 25, MID)
        observed = observe_views(cell.views)
        state = true_state(cell)
        linear = Linear.at(observed, state, observed.present)
        prior = Priors(LensPrior.given(cell.camera, np.full(9, 1e-6)), BoardTolerance(1e-7, 1e-8))
        scales = linear.first_scales()
        for _ in range(3):
            scales = linear.solve(prior.linearise(state, 0.0), scales).scales
        found.append([scales.tau_px, scales.sigma_px, *scales.robot])
    expected = [MID.corner_px, MID.corner_px, MID.robot_m, MID.robot_rad]
    np.testing.assert_allclose(np.mean(found, axis=0), expected, rtol=0.15)


def test_an_unclear_view_costs_information_but_never_more_than_it_tells():
    cell = make_cell(np.random.default_rng(0), 12, MeasurementNoise(0.1, 1e-4, 1e-4))
    observed = observe_views(cell.views)
    for size in (0.0, 4.0, 100.0):
        flange = observed.flange.copy()
        flange[3] = perturb(flange[3], size * np.repeat([1e-4, 1e-4], 3))
        seen = replace(observed, flange=flange)
        state = true_state(cell)
        linear = Linear.at(seen, state, seen.present)
        prior = Priors(LensPrior.given(cell.camera), BoardTolerance()).linearise(state, 0.0)
        solved = linear.solve(prior, linear.first_scales())
        lost = linear.lost(solved)
        assert np.linalg.eigvalsh(lost).min() > -1e-6 * np.abs(lost).max()
        assert (np.diag(linear.covariance(solved)) >= np.diag(np.linalg.inv(solved.precision)) * 0.999).all()


@MOUNTS
def test_the_evidence_is_that_of_the_views_not_of_where_they_are_linearised(mount):
    """Estimates from two starts end at two lenses, whose priors and corners cost unlike much."""
    cell = make_cell(np.random.default_rng(5), 12, MID, mount=mount)
    observed, priors = observe_views(cell.views), Priors(LensPrior.given(cell.camera), BoardTolerance())
    scales = Scales(np.array([3e-4, 5e-4]), 0.3, 0.25, 0.2, ONE_CLASS)
    away = np.zeros(Layout.of(true_state(cell)).size)
    found = []
    for focal_px, bend_m in ((0.0, 0.0), (1.5, 0.0), (0.0, 1e-4)):
        away[Layout.of(true_state(cell)).lens][:2], away[-1] = focal_px, bend_m
        state = true_state(cell).moved(away, np.zeros((12, 6)))
        linear = Linear.at(observed, state, observed.present)
        found.append(linear.solve(priors.linearise(state, 0.0), scales, "nothing").log_evidence)
    assert found == pytest.approx([found[0]] * 3, abs=0.05)
