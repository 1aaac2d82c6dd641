"""Do given intrinsics still hold on these pictures? A wrong lens shifts X and no residual need show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from calibrate.errors import BadViewsError
from calibrate.estimate import Estimate, estimate
from calibrate.likelihood.model import Observations
from calibrate.projection import INTRINSICS, intrinsics_vector
from recordings.messages import CameraModel

_FALSE_ALARM = 1e-5
_FEWEST_VIEWS = 10
"""Fewer would have to tell nine parameters of the lens from chance."""
_ORIGINS = {
    1.0: "if the first pixel is counted as 1",
    0.5: "if pixel coordinates start at the corner of the first pixel",
}
"""How much larger coordinates are than here, where the middle of the first pixel is (0, 0)."""
_FAVOURED, _FAVOURED_MIDDLE = 16.0, 4.0
"""Gain of -2 log likelihood that makes another origin credible; less is asked of a principal point that is
the picture's exact middle there: nobody measured it."""


def check_lens(observed: Observations, held: Estimate) -> str:
    """A sentence when refining the held intrinsics would change them beyond chance, else "".

    Wald's test: with d their change and C its covariance, dᵀ C⁻¹ d / 9 follows F(9, 3n - 6) if they hold, n
    views. A principal point counted from another origin is named first. `held`: the estimate with the given
    lens. "" for fewer than ten views too, without pixels, for lenses other than plumb_bob, where the views
    determine no lens.
    """
    camera = held.state.camera
    if len(held.state.C) < _FEWEST_VIEWS or not observed.has_pixels or camera.distortion_model != "plumb_bob":
        return ""
    try:
        return _other_origin(observed, held) or _misfit(observed, held)
    except BadViewsError:
        return ""


def _misfit(observed: Observations, held: Estimate) -> str:
    camera = held.state.camera
    free = estimate(observed, held.state, True, held.sigma)
    change = intrinsics_vector(free.state.camera) - intrinsics_vector(camera)
    covariance = free.normal.solve(free.sigma**-2).covariance[12:21, 12:21]
    statistic = float(change @ np.linalg.solve(covariance, change)) / len(INTRINSICS)
    limit = float(stats.f.ppf(1 - _FALSE_ALARM, len(INTRINSICS), 3 * len(held.state.C) - 6))
    if not statistic > limit:
        return ""
    shift_mm = 1e3 * float(np.linalg.norm(free.state.X[:3, 3] - held.state.X[:3, 3]))
    return (
        f"The given intrinsics do not fit these pictures (misfit {statistic / limit:.1f} times the limit; "
        f"refining them would move X by {shift_mm:.2f} mm). Calibrate the camera again, or find the "
        "intrinsics from these pictures."
    )


def _other_origin(observed: Observations, held: Estimate) -> str:
    camera = held.state.camera
    centre = [INTRINSICS.index("cx"), INTRINSICS.index("cy")]
    others = tuple(sorted(set(range(len(INTRINSICS))) - set(centre)))
    free = estimate(replace(observed, held=others), held.state, True, held.sigma)
    change = (intrinsics_vector(free.state.camera) - intrinsics_vector(camera))[centre]
    places = 12 + np.array(centre)
    covariance = free.normal.solve(free.sigma**-2).covariance[np.ix_(places, places)]
    weight = np.linalg.inv(covariance)
    for offset, counted in _ORIGINS.items():
        left = change + offset
        gain = float(change @ weight @ change - left @ weight @ left)
        middle = _is_middle(camera, offset)
        fits = float(left @ weight @ left) < stats.chi2.ppf(0.99, 2)
        if fits and gain > (_FAVOURED_MIDDLE if middle else _FAVOURED):
            cx, cy = intrinsics_vector(camera)[centre]
            sd = np.sqrt(np.diag(covariance))
            exact = "is the exact middle of the picture" if middle else "fits these pictures"
            return (
                f"The given principal point ({cx:g}, {cy:g}) {exact} {counted}; here the middle of the first "
                f"pixel is (0, 0). These pictures want it moved by {change[0]:+.2f} ± {sd[0]:.2f} and "
                f"{change[1]:+.2f} ± {sd[1]:.2f} px. Subtract {offset:g} from cx and cy and solve again."
            )
    return ""


def _is_middle(camera: CameraModel, offset: float) -> bool:
    cx, cy = intrinsics_vector(camera)[2:4]
    x, y = (camera.width - 1) / 2 + offset, (camera.height - 1) / 2 + offset
    return bool(abs(cx - x) < 0.01 and abs(cy - y) < 0.01)
