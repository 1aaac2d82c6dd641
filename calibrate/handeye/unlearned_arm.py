"""The part of a placed point's error that is the arm's own, before a solve has learned or judged it.

A quick fit and a plan model no errors of the arm: what of them varies from view to view is in the noise. But
errors of links are smooth over the postures, and X and the board's place take most of them up, so that the
views agree better than a point is placed. A typical arm of the class (`assumed_arm`) stands for them here:
its links have the class's errors beforehand, and as much of them is left as the views do not tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.arms.classes import ArmClass
from calibrate.handeye.assumed_arm import assumed_postures, link_sizes
from calibrate.handeye.information import predicted_error_m, prior_information, view_information
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.placed_point import PointPrediction
from calibrate.handeye.priors import BoardTolerance
from recordings.geometry import Array
from recordings.schema.messages import CameraModel, Mount


@dataclass(frozen=True, eq=False)
class UnlearnedArm:
    """What each view tells of a typical arm's links, and what a point misses by the rest."""

    by_views: Array
    """(n, p, p) information of each view; the errors of the links are the last parameters."""
    prior: Array
    """(p, p) before any view."""
    with_links: PointPrediction
    without_links: PointPrediction

    @classmethod
    def of(
        cls,
        mount: Mount,
        camera: CameraModel,
        base_from_flange: Array,
        X: Array,
        Y: Array,
        points: Array,
        noise: MeasurementNoise,
        tolerance: BoardTolerance,
        lens_known: bool,
        of_class: ArmClass,
        distance_m: float,
    ) -> UnlearnedArm | None:
        """Put a typical arm of the class to the flanges (n, 4, 4); None where no such arm reaches them all.

        X, Y: (4, 4) as in `information`; points: (k, 3) of the board; noise: of the views; distance_m: of the
        placed point from the camera.
        """
        arm = assumed_postures(base_from_flange)
        if arm is None:
            return None
        by_links = arm.chain.by_links(arm.joints_rad)
        sizes = link_sizes(arm, of_class)
        sigma = np.tile(np.repeat([sizes.shift_mm, sizes.turn_mrad], 3), by_links.shape[2] // 6)
        return cls(
            by_views=view_information(mount, camera, base_from_flange, X, Y, points, noise, by_links),
            prior=prior_information(camera, lens_known, tolerance, sigma),
            with_links=PointPrediction.of(mount, X, base_from_flange, distance_m, noise, by_links),
            without_links=PointPrediction.of(mount, X, base_from_flange, distance_m, noise),
        )

    def part_m(self, weights: Array) -> float:
        """Compute the rms of |e| (`placed_point`) by errors of links, metres.

        weights: (n,) how much each view counts. Raises LinAlgError where X and Y put the board out of sight.
        """
        information = np.tensordot(weights, self.by_views, 1)
        if not np.isfinite(information).all():
            raise np.linalg.LinAlgError("the board is out of sight")
        links = self.with_links.point.by_unknown.shape[2] - 6
        with_links_m = predicted_error_m(information, self.prior, self.with_links)
        without_m = predicted_error_m(
            information[:-links, :-links], self.prior[:-links, :-links], self.without_links
        )
        return float(np.sqrt(max(with_links_m**2 - without_m**2, 0.0)))
