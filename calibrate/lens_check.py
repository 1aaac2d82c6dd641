"""Do given intrinsics still hold on these pictures? A wrong lens shifts X and no residual need show it."""

from __future__ import annotations

import numpy as np
from scipy import stats

from calibrate.errors import BadViewsError
from calibrate.estimate import Estimate, estimate
from calibrate.likelihood.model import Observations
from calibrate.projection import INTRINSICS, intrinsics_vector

_FALSE_ALARM = 1e-5
_FEWEST_VIEWS = 10


def check_lens(observed: Observations, held: Estimate) -> str:
    """A sentence when refining the held intrinsics would change them beyond chance (Wald test), else ""."""
    camera = held.state.camera
    if len(held.state.C) < _FEWEST_VIEWS or not observed.has_pixels or camera.distortion_model != "plumb_bob":
        return ""
    try:
        free = estimate(observed, held.state, True, held.sigma)
    except BadViewsError:
        return ""
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
