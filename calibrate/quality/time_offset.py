"""The time between two clocks, from an arm in slow motion: when the camera turned, the flange turned as much.

For any X the flange and the camera (or the board on the flange) turn by equal angles between two moments,
so the angles of the robot, taken later or earlier until they fit those of the pictures, give the offset with
no calibration at hand. The arm must speed up and slow down: at constant speed every offset fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from calibrate.errors import BadViewsError, DegenerateMotionError, TooFewViewsError
from calibrate.geometry import Array, rotation_angle

FEWEST_PICTURES = 12
LIMIT_S = 0.2
"""Offsets beyond it are not looked for."""
_STEPS = 81
"""Of the first search, 5 ms apart."""
_ITERATIONS = 20
_DIFFERENCE_S = 1e-4
"""Half the distance of the two values that give a slope."""


@dataclass(frozen=True)
class TimeOffset:
    offset_s: float
    """A picture stamped t was taken at t + offset on the robot's clock."""
    sigma_s: float
    rms_rad: float
    """Of the angles that were compared."""
    pairs: int
    lost: tuple[str, ...] = ()
    """Pictures that could not be used, each in words"""


def estimate_time_offset(
    robot_s: Array,
    base_from_flange: Array,
    camera_s: Array,
    camera_from_board: Array,
) -> TimeOffset:
    """Robot times (n,) and poses (n, 4, 4); picture times (m,) and PnP poses (m, 4, 4), in order; seconds.

    Least squares over r_i = ∠(F(t_i + τ)⁻¹ F(t_i+1 + τ)) - ∠(C_i⁻¹ C_i+1), F base_from_flange (slerp between
    the robot's times) and C camera_from_board: the best of a grid, then Gauss-Newton with Huber's weights.
    Raises TooFewViewsError, BadViewsError for times out of order, DegenerateMotionError where the motion does
    not determine the offset.
    """
    for name, times in (("robot", robot_s), ("camera", camera_s)):
        if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise BadViewsError(f"the {name}'s times are not in order; are two recordings mixed?")
    inside = (camera_s - LIMIT_S >= robot_s[0]) & (camera_s + LIMIT_S <= robot_s[-1])
    times, poses = camera_s[inside], camera_from_board[inside]
    if len(times) < FEWEST_PICTURES:
        raise TooFewViewsError(
            f"only {len(times)} pictures lie within the robot's recording; {FEWEST_PICTURES} are needed for "
            "a time offset. Sweep longer, with the board in view"
        )
    flange = Slerp(robot_s, Rotation.from_matrix(base_from_flange[:, :3, :3]))
    R = poses[:, :3, :3]
    seen = rotation_angle(np.swapaxes(R[:-1], -1, -2) @ R[1:])

    def residual(offset_s: float) -> Array:
        turned = flange(times + offset_s)
        return np.asarray((turned[:-1].inv() * turned[1:]).magnitude() - seen)

    grid = np.linspace(-LIMIT_S, LIMIT_S, _STEPS)
    offset_s = float(grid[np.argmin([np.abs(residual(o)).sum() for o in grid])])
    for _ in range(_ITERATIONS):
        r, slope = residual(offset_s), _slope(residual, offset_s)
        weight = _weights(r)
        step_s = float(-(weight * slope * r).sum() / max((weight * slope**2).sum(), 1e-30))
        offset_s = float(np.clip(offset_s + step_s, -LIMIT_S, LIMIT_S))
        if abs(step_s) < 1e-8:
            break
    r, slope = residual(offset_s), _slope(residual, offset_s)
    sigma_s = _sigma(r, slope, _weights(r))
    if sigma_s > LIMIT_S / 4 or abs(offset_s) >= LIMIT_S - 1e-9:
        raise DegenerateMotionError(
            f"the motion does not determine the time offset (sigma {1000 * sigma_s:.0f} ms within "
            f"± {1000 * LIMIT_S:.0f} ms): the arm must turn, and speed up and slow down, during the sweep"
        )
    return TimeOffset(offset_s, sigma_s, float(np.sqrt(np.mean(r**2))), len(r))


def _slope(residual: Callable[[float], Array], offset_s: float) -> Array:
    low = max(offset_s - _DIFFERENCE_S, -LIMIT_S)
    high = min(offset_s + _DIFFERENCE_S, LIMIT_S)
    return np.asarray((residual(high) - residual(low)) / (high - low))


def _weights(r: Array) -> Array:
    """Huber's (1964), 95 % efficient at 1.345 sigmas: a picture with a wrong pose must not shift the time."""
    scale = 1.345 * max(1.4826 * float(np.median(np.abs(r))), 1e-12)
    return np.asarray(np.minimum(1.0, scale / np.maximum(np.abs(r), 1e-15)))


def _sigma(r: Array, slope: Array, weight: Array) -> float:
    """Sandwich estimate (Huber 1967); neighbouring angles share a picture, so their products count too."""
    score = weight * slope * r
    together = float((score**2).sum() + 2 * (score[:-1] * score[1:]).sum())
    # The sum of neighbours can be negative by chance: a quarter of the plain estimate is the least believed.
    spread = max(together, 0.25 * float((score**2).sum()))
    curvature = float((weight * slope**2).sum())
    return float(np.sqrt(spread)) / max(curvature, 1e-30)
