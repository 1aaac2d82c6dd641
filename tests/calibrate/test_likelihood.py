"""The likelihood's derivatives against differences, its inverses against a dense one."""

import numpy as np
import pytest

from calibrate.geometry import difference, perturb
from calibrate.kinematics import MODELS, DhDeltas, forward
from calibrate.likelihood.kinematics import UNIT, table_derivatives
from calibrate.likelihood.model import State, observe_views
from calibrate.likelihood.noise import reml_scales
from calibrate.likelihood.normal import weighed
from calibrate.likelihood.residuals import (
    corner_distance,
    corner_residuals,
    linearise,
    robot_derivatives,
    robot_residuals,
)
from tests.calibrate.cells import MID, make_cell


def setting(mount, views=5, far=0.3):
    """A state away from the truth, so that no derivative is tested where its parts vanish."""
    rng = np.random.default_rng(0)
    cell = make_cell(rng, views, MID, mount=mount)
    observed = observe_views(cell.views)
    state = State(
        perturb(cell.X, far * rng.normal(size=6)),
        perturb(cell.Y, far * rng.normal(size=6)),
        cell.views.camera_from_board,
        cell.camera,
        np.zeros(0),
    )
    return observed, state, cell


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_robot_residuals_are_differentiated_exactly(mount, which):
    observed, state, _ = setting(mount)
    exact = robot_derivatives(observed, state)[which]
    h = 1e-6
    for k in range(6):
        residuals = []
        for sign in (h, -h):
            by_global, by_view = np.zeros(12), np.zeros((5, 6))
            if which == 2:
                by_view[:, k] = sign
            else:
                by_global[6 * which + k] = sign
            residuals.append(robot_residuals(observed, state.moved(by_global, by_view, False)))
        numeric = (residuals[0] - residuals[1]) / (2 * h)
        np.testing.assert_allclose(exact[:, :, k], numeric, atol=1e-7)


def dense(observed, state, precision, intrinsics_free):
    """Normal matrix and right side by differences of all residuals over all parameters."""
    size = 12 + 9 * intrinsics_free
    n = len(state.C)
    root = np.sqrt(precision)

    def residuals(step):
        moved = state.moved(step[:size], step[size:].reshape(n, 6), intrinsics_free)
        e = robot_residuals(observed, moved)
        corners = -corner_residuals(observed, moved)
        return np.concatenate(
            [root[0] * corners.ravel(), root[1] * e[:, :3].ravel(), root[2] * e[:, 3:].ravel()]
        )

    count = size + 6 * n
    J = np.empty((len(residuals(np.zeros(count))), count))
    for k in range(count):
        h = 1e-6 * np.eye(count)[k]
        J[:, k] = (residuals(h) - residuals(-h)) / 2e-6
    return J, residuals(np.zeros(count))


@pytest.mark.parametrize("intrinsics_free", [False, True])
def test_elimination_of_the_views_equals_the_dense_solution(intrinsics_free):
    observed, state, _ = setting("eye-in-hand", far=1e-3)
    precision = np.array([0.2, 0.3e-3, 5e-4, 1.0]) ** -2
    J, r = dense(observed, state, precision, intrinsics_free)
    normal = linearise(observed, state, observed.present, intrinsics_free)
    solved = normal.solve(precision)
    inverse = np.linalg.inv(J.T @ J)
    size = normal.size
    np.testing.assert_allclose(solved.covariance[:6, :6], inverse[:6, :6], rtol=1e-4, atol=1e-12)
    step = -inverse @ J.T @ r
    np.testing.assert_allclose(solved.step[:12], step[:12], rtol=1e-3, atol=1e-8)
    np.testing.assert_allclose(solved.by_view.ravel(), step[size:], rtol=1e-3, atol=1e-7)
    rows = {0: slice(0, observed.present.sum().astype(int) * 2)}
    trace = np.trace(inverse @ J[rows[0]].T @ J[rows[0]])
    assert solved.traces()[0] * precision[0] == pytest.approx(trace, rel=1e-4)
    assert solved.log_determinant == pytest.approx(np.linalg.slogdet(J.T @ J)[1], rel=1e-5)
    after = r + J @ step
    assert solved.squares_after_step() @ precision == pytest.approx(after @ after, rel=1e-4)
    parts = solved.contributions(precision)
    np.testing.assert_allclose(parts.sum(axis=0), solved.covariance[:6, :6], rtol=1e-6, atol=1e-15)


def test_noise_scales_come_out_as_they_went_in():
    """Mean over cells, within 5 %: plain residual scatter would be far too small for the robot."""
    found = []
    for seed in range(12):
        cell = make_cell(np.random.default_rng(seed), 25, MID)
        observed = observe_views(cell.views)
        state = State(cell.X, cell.Y, cell.C, cell.camera, np.zeros(0))
        normal = linearise(observed, state, observed.present, False)
        found.append(reml_scales(normal, np.array([1.0, 1e-2, 1e-2, 1.0]), True)[:3])
    expected = [MID.corner_px, MID.robot_m, MID.robot_rad]
    np.testing.assert_allclose(np.mean(found, axis=0), expected, rtol=0.06)


def test_table_errors_move_the_flange_as_stated():
    model = MODELS["UR10"]
    joints = np.random.default_rng(0).uniform(-2, 2, size=(4, 6))
    derivatives = table_derivatives(model, joints) / UNIT
    h = 1e-6
    for k in range(24):
        table = np.zeros(24)
        table[k] = h
        a, d, alpha, theta = (tuple(part) for part in table.reshape(4, 6))
        moved = forward(model.calibrated(DhDeltas(a, d, alpha, theta)), joints)
        numeric = difference(moved, forward(model, joints)) / h
        np.testing.assert_allclose(derivatives[:, :, k], numeric, atol=1e-5)


def test_shortcuts_give_numpys_own_bits() -> None:
    """A solve that is repeated, or was made by a release before, gives the same file."""
    rng = np.random.default_rng(3)
    residuals, blocks, precision = rng.normal(size=(7, 5, 2)), rng.normal(size=(4, 7, 6, 6)), rng.random(4)
    assert np.array_equal(corner_distance(residuals), np.linalg.norm(residuals, axis=-1))
    assert np.array_equal(weighed(precision, blocks), np.tensordot(precision, blocks, axes=1))
