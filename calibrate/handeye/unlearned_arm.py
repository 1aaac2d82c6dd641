"""The part of a placed point's error that is the arm's own, before a solve has learned or judged it.

A quick fit models no errors of the arm: what of them varies from view to view is in its noise. But errors of
links are smooth over the postures, and X and the board's place take most of them up, so that the views agree
better than a point is placed. A typical arm of the class (`assumed_arm`) stands for them here: its links have
the class's errors beforehand, and as much of them is left as the views do not tell.
"""

from __future__ import annotations

import numpy as np

from calibrate.arms.classes import ArmClass
from calibrate.handeye.assumed_arm import assumed_postures, link_sizes
from calibrate.handeye.information import predicted_error_m, prior_information, view_information
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.placed_point import PointPrediction
from calibrate.handeye.priors import BoardTolerance
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array


def arm_part_m(
    views: ViewSet,
    X: Array,
    Y: Array,
    points: Array,
    noise: MeasurementNoise,
    weights: Array,
    tolerance: BoardTolerance,
    lens_known: bool,
    of_class: ArmClass,
    distance_m: float,
) -> float:
    """Compute the rms of |e| (`placed_point`) by errors of links, metres; 0 where no typical arm reaches all.

    X, Y: (4, 4) as in `information`; points: (k, 3) of the board; noise: of the views; weights: (n,) how much
    each view counts; distance_m: of the placed point from the camera. Raises LinAlgError where X and Y put
    the board out of sight.
    """
    flange = views.base_from_flange
    arm = assumed_postures(flange)
    if arm is None:
        return 0.0
    sizes = link_sizes(arm, of_class)
    by_links = arm.chain.by_links(arm.joints_rad)
    count = by_links.shape[2]
    sigma = np.tile(np.repeat([sizes.shift_mm, sizes.turn_mrad], 3), count // 6)
    each = view_information(views.mount, views.camera, flange, X, Y, points, noise, by_links)
    information = np.tensordot(weights, each, 1)
    if not np.isfinite(information).all():
        raise np.linalg.LinAlgError("the board is out of sight")
    prior = prior_information(views.camera, lens_known, tolerance, sigma)
    with_links = PointPrediction.of(views.mount, X, flange, distance_m, noise, by_links)
    without = PointPrediction.of(views.mount, X, flange, distance_m, noise)
    error_m = predicted_error_m(information, prior, with_links)
    known_m = predicted_error_m(information[:-count, :-count], prior[:-count, :-count], without)
    return float(np.sqrt(max(error_m**2 - known_m**2, 0.0)))
