"""The information that planning uses is that of the solver's own estimate."""

from dataclasses import replace

import numpy as np

from calibrate.handeye.information import (
    covariance_of,
    predicted_error_m,
    prior_information,
    view_information,
)
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.placed_point import PointPrediction
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.solve import solve_views
from tests.calibrate.cells import MOUNTS, QUICK, make_cell


@MOUNTS
def test_the_predicted_sigma_is_the_one_that_the_solver_states(mount):
    """25 views of a cell whose arm is told to be exact: geometry alone says what the estimate will claim."""
    noise = MeasurementNoise(0.5, 5e-5, 1e-4)  # robot and corners count alike
    cell = make_cell(np.random.default_rng(4), 25, noise, mount=mount)
    exact = replace(QUICK, intrinsics_from_same_pictures=True, robot_accuracy_m=1e-6)
    solution = solve_views(cell.views, exact)
    points = cell.views.views[0].corners.points
    each = view_information(mount, cell.camera, cell.flange, cell.X, cell.Y, points, noise)
    prior = prior_information(cell.camera, False, BoardTolerance())
    predicted = np.diag(covariance_of(each.sum(axis=0), prior))
    X = np.sqrt(np.diag(solution.covariance) / predicted[:6])
    lens = np.sqrt(np.diag(solution.fit.lens_covariance) / predicted[12:21])
    figures = solution.judgement.figures
    point = PointPrediction.of(mount, cell.X, cell.flange, figures.working_distance_m, noise)
    shown_m = predicted_error_m(each.sum(axis=0), prior, point)
    assert (X > 0.8).all() and (X < 1.4).all()
    assert (lens > 0.9).all() and (lens < 1.1).all()
    assert 0.85 < 1e3 * shown_m / figures.predicted_error_mm < 1.15
