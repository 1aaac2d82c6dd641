"""Are the robot's positions and orientations stated in one frame? No camera and no board can turn one alone.

The frame that the base end of the chain stands in is found twice: from the flange's positions alone and from
its orientations alone. For a sound arm they agree. They do not where poses were put together from two
sources, and where joint zeros or the kinematic table are wrong.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from calibrate.geometry import Array, inverse, rotation_exp, rotation_log, skew
from calibrate.likelihood.model import Observations, State

_FALSE_ALARM = 1e-6
_LEAST_DEG = 0.1
"""Less turns a point one metre away by less than 2 mm: left to the noise."""
_FEWEST_VIEWS = 8
_STEPS = 10


def check_frames(observed: Observations, state: State) -> str:
    """A sentence where orientations are turned against positions beyond chance (F test), else "".

    state: the final estimate, its C by each view's own corners.
    """
    n = len(state.C)
    if n < _FEWEST_VIEWS:
        return ""
    eye_in_hand = observed.mount == "eye-in-hand"
    near, far = (state.Y, state.X) if eye_in_hand else (state.X, state.Y)
    middle = inverse(state.C) if eye_in_hand else state.C
    try:
        by_position, spread = _near_by_positions(observed.flange[:, :3, 3], middle, near, far)
        by_orientation, scatter = _near_by_orientations(observed.flange[:, :3, :3], middle, near, far)
    except np.linalg.LinAlgError:
        return ""  # the motion does not tell one of them
    turn = rotation_log(by_orientation @ by_position.T)
    statistic = float(turn @ np.linalg.solve(spread + scatter, turn)) / 3
    limit = float(stats.f.ppf(1 - _FALSE_ALARM, 3, 3 * n - 9))
    turned_deg = float(np.degrees(np.linalg.norm(turn)))
    if not (statistic > limit and turned_deg > _LEAST_DEG):
        return ""
    return (
        f"The robot's orientations are turned by {turned_deg:.2f}° against its positions "
        f"({statistic / limit:.1f} times the limit of chance). Neither camera nor board does that: the joint "
        "zeros or the kinematic table of the arm are off, or position and orientation of the poses come from "
        "two sources. Record poses as the controller computes them, with the arm's factory calibration; else "
        "have the arm calibrated."
    )


def _near_by_positions(positions: Array, middle: Array, near: Array, far: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) of the near frame and its covariance: t_i = t + R (R_i q + t_i'), unknown R, t, q."""
    R, t, q = near[:3, :3].copy(), near[:3, 3].copy(), -far[:3, :3].T @ far[:3, 3]
    for _ in range(_STEPS):
        arm = (middle[:, :3, :3] @ q + middle[:, :3, 3]) @ R.T
        residual = (positions - t - arm).ravel()
        J = np.concatenate(
            [-skew(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3)), R @ middle[:, :3, :3]], axis=2
        ).reshape(-1, 9)
        step, covariance = _least_squares(J, residual)
        R, t, q = rotation_exp(step[:3]) @ R, t + step[3:6], q + step[6:]
        if np.abs(step).max() < 1e-10:
            break
    return R, covariance[:3, :3]


def _near_by_orientations(R_flange: Array, middle: Array, near: Array, far: Array) -> tuple[Array, Array]:
    """The same from R_i = R M_i Q, unknown R and Q."""
    R, Q = near[:3, :3].copy(), far[:3, :3].T.copy()
    for _ in range(_STEPS):
        left = R @ middle[:, :3, :3]
        residual = rotation_log(R_flange @ np.swapaxes(left @ Q, 1, 2)).ravel()
        J = np.concatenate([np.broadcast_to(np.eye(3), left.shape), left], axis=2).reshape(-1, 6)
        step, covariance = _least_squares(J, residual)
        R, Q = rotation_exp(step[:3]) @ R, rotation_exp(step[3:]) @ Q
        if np.abs(step).max() < 1e-10:
            break
    return R, covariance[:3, :3]


def _least_squares(J: Array, residual: Array) -> tuple[Array, Array]:
    """Step and covariance by the residuals' scatter. LinAlgError where the motion leaves unknowns open."""
    scale = 1.0 / np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    scaled = J * scale
    information = scaled.T @ scaled
    if np.linalg.cond(information) > 1e10:
        raise np.linalg.LinAlgError
    inverse_ = np.linalg.inv(information) * np.outer(scale, scale)
    step = inverse_ @ J.T @ residual
    left = residual - J @ step
    return step, inverse_ * float(left @ left) / (len(left) - J.shape[1])
