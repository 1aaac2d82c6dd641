"""The rule of standing still: the station's before an image, and the importers' for other people's arms.

Over a window the flange stays within `POSITION_M` of its mean place and `ROTATION_RAD` of its newest
orientation, and no joint is faster than `JOINT_SPEED_RAD_S`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

WINDOW_S = 0.3
POSITION_M = 0.00005
ROTATION_RAD = 0.00005
JOINT_SPEED_RAD_S = 0.002
LEAST_SAMPLES = 8


def scatter(base_from_flange: NDArray[np.float64]) -> tuple[float, float]:
    """Measure poses (n, 4, 4): distance (m) from their mean place, angle (rad) to the newest; the largest."""
    import numpy as np

    places, R = base_from_flange[:, :3, 3], base_from_flange[:, :3, :3]
    turned = np.swapaxes(R, -1, -2) @ R[-1]
    # Sine and cosine: near zero the trace alone would lose half of the digits.
    sine = np.linalg.norm(turned - np.swapaxes(turned, -1, -2), axis=(1, 2)) / np.sqrt(8)
    angle = np.arctan2(sine, (np.trace(turned, axis1=1, axis2=2) - 1) / 2)
    away = np.linalg.norm(places - places.mean(axis=0), axis=1)
    return float(away.max()), float(angle.max())
