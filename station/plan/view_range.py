"""From where the board may be looked at, and how sure it must be to be seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.boards.model import board_points
from calibrate.projection import camera_matrix
from station.cell.scene import Scene


@dataclass(frozen=True)
class ViewRange:
    """From where the board may be looked at."""

    distance_m: tuple[float, float] = (0.38, 0.60)
    tilt_rad: tuple[float, float] = (0.0, 0.70)
    roll_rad: float = 0.80
    """Either way from `roll_centre_rad`."""
    roll_centre_rad: float = 0.0
    off_centre: float = 0.35
    """Share of half the picture that the board's centre may be away from the picture's centre."""
    border_px: float = 12.0
    doubt: float = 3.5
    """So many standard deviations of its pixels, as the guesses' sigmas make them, every corner of the board
    keeps from the picture's edge beyond `border_px`."""
    smallest_singular: float = 0.03


_NEAR_FILL, _FAR_FILL = 0.64, 0.40
"""Share of the picture's width or height that the board's outline fills, at the nearest and farthest."""
_FOCUS = (0.6, 1.6)
"""Pictures are sharp within these multiples of the working distance."""


def view_range(scene: Scene) -> ViewRange:
    """Distances at which the board fills the picture well, as far as they lie near the working distance."""
    K = camera_matrix(scene.camera)
    points = board_points(scene.board)
    size_m = (points.max(axis=0) - points.min(axis=0))[:2] + scene.board.square_m
    picture = np.array([scene.camera.width, scene.camera.height])
    full_m = float((np.diag(K)[:2] * size_m / picture).max())
    focus = np.array(_FOCUS) * scene.working_distance_m
    near, far = (float(d) for d in np.clip([full_m / _NEAR_FILL, full_m / _FAR_FILL], *focus))
    if far < 1.2 * near:
        near, far = full_m / _NEAR_FILL, full_m / _FAR_FILL
    return ViewRange(distance_m=(near, far))
