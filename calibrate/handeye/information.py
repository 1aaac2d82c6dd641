"""Fisher information of views about X, board pose, lens and board shape, from geometry alone.

The model is that of the estimate (`handeye.linear`): corner noise, and an independent error of every robot
pose. Parameter order: δX (6), δY (6), the lens (`projection.intrinsics_names`),
the board's shape (`results.SHAPE`), and the errors of the arm's links (`Chain.by_links`) where their motion
is given. Deltas are those of `geometry.perturb`.
X = flange_from_camera, Y = base_from_board (eye-in-hand), or X = base_from_camera, Y = flange_from_board
(eye-to-hand).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from calibrate.handeye.blas_threads import one_blas_thread
from calibrate.handeye.cell_state import CellState, Layout
from calibrate.handeye.linear import Linear
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.placed_point import PointPrediction
from calibrate.handeye.priors import BoardTolerance, LensPrior, Priors
from calibrate.results import SHAPE
from calibrate.views.arrays import array_of
from calibrate.views.projection import camera_matrix
from calibrate.views.view_set import Observations, board_in_camera, extent_of, require_mount
from recordings.geometry import Array
from recordings.schema.messages import CameraModel, Mount

_FOCAL_SHARE = 0.05
"""Prior 1σ of an unknown focal length, relative: keeps the prediction finite with few views."""
_LINK_ERRORS = 30
"""Errors of the links of an arm with six joints, as in `Chain.by_links`."""
_POSE_PRECISION = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""Prior of a pose, 1 m and about 3 rad: practically none, but the first few views get a finite sigma."""


USUAL_NOISE = MeasurementNoise()


@one_blas_thread()
def view_information(
    mount: Mount,
    camera: CameraModel,
    base_from_flange: ArrayLike,
    X: ArrayLike,
    Y: ArrayLike,
    board_points: ArrayLike,
    noise: MeasurementNoise,
    by_arm_errors: Array | None = None,
) -> Array:
    """Compute each view's information (n, p, p), the whole board (k, 3) seen from flange poses (n, 4, 4).

    The view's own robot error is marginalised, so views simply add. `by_arm_errors`: (n, 6, q) motion of the
    flange by each error of the arm's links.
    """
    require_mount(mount)
    flange = array_of(base_from_flange, (-1, 4, 4), "base_from_flange")
    points = array_of(board_points, (-1, 3), "board_points")
    X, Y = array_of(X, (4, 4), "X"), array_of(Y, (4, 4), "Y")
    n, k = len(flange), len(points)
    C = board_in_camera(mount, flange, X, Y)
    errors = np.zeros((n, 6, 0)) if by_arm_errors is None else by_arm_errors
    observed = Observations(
        mount,
        flange,
        np.broadcast_to(points, (n, k, 3)),
        np.zeros((n, k, 2)),
        np.ones((n, k)),
        errors,
        extent_of(points),
    )
    state = CellState(X, Y, C, camera, np.zeros(len(SHAPE)), np.zeros(errors.shape[2]))
    linear = Linear.at(observed, state, observed.present, information=1.0)
    robot = np.repeat([noise.robot_m, noise.robot_rad], 3) ** 2
    W = np.linalg.inv(noise.corner_px**2 * linear.V + np.diag(robot))
    J_t = np.swapaxes(linear.J, 1, 2)
    information = J_t @ W @ linear.J
    if linear.modes is not None:
        shared = linear.modes.shared
        information[:, shared, shared] += linear.modes.free.information / noise.corner_px**2
    return np.asarray(information)


@one_blas_thread()
def prior_information(
    camera: CameraModel,
    lens_known: bool,
    board: BoardTolerance,
    arm_error_mm: float | Array = 0.0,
) -> Array:
    """Compute the prior information (p, p), before any view, of lens and board tolerance.

    `arm_error_mm`: 1σ, mm and mrad, of errors of the arm's links, for each (q,) or one for all of six joints;
    0: none are modelled.
    """
    if np.ndim(arm_error_mm):
        errors = np.zeros(np.size(arm_error_mm))
    else:
        errors = np.zeros(_LINK_ERRORS if arm_error_mm else 0)
    state = CellState(np.eye(4), np.eye(4), np.zeros((0, 4, 4)), camera, np.zeros(len(SHAPE)), errors)
    lens = LensPrior.given(camera) if lens_known else LensPrior.unknown(camera)
    N = Priors(lens, board).linearise(state, arm_error_mm).N
    at = Layout.of(state)
    N[np.arange(12), np.arange(12)] += np.tile(_POSE_PRECISION, 2)
    N[at.lens.start, at.lens.start] += (_FOCAL_SHARE * camera_matrix(camera)[0, 0]) ** -2.0
    return N


@one_blas_thread()
def covariance_of(information: Array, prior: Array | None = None) -> Array:
    """Invert information (..., p, p) to covariance, scaled so that metres and pixels do not clash.

    `prior` (p, p) is added. Directions without information get a huge variance.
    """
    M = information if prior is None else information + prior
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(M, axis1=-2, axis2=-1), 1e-12))
    scaled = M * scale[..., :, None] * scale[..., None, :]
    scaled = scaled + 1e-12 * np.eye(M.shape[-1])
    return np.asarray(np.linalg.inv(scaled) * scale[..., :, None] * scale[..., None, :])


MORE_VIEWS = 10
"""Views more that are asked what they would lower."""


def predicted_error_m(information: Array, prior: Array, point: PointPrediction) -> float:
    """Predict the error of a placed point, metres, from information (p, p) and its prior.

    The errors of the arm that `point` models are the last in the order of the parameters.
    """
    covariance = covariance_of(information, prior)
    count = len(covariance)
    errors = point.point.by_unknown.shape[2] - 6
    places = np.append(np.arange(6), np.arange(count - errors, count))
    return point.error_m(covariance[np.ix_(places, places)])


def with_more_views_m(information: Array, prior: Array, point: PointPrediction, views: float) -> float:
    """Predict as `predicted_error_m` what `MORE_VIEWS` more of the kind of these `views` would leave."""
    return predicted_error_m(information * (1.0 + MORE_VIEWS / max(views, 1.0)), prior, point)
