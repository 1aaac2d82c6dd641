"""How errors of the arm's Denavit-Hartenberg table move the flange: the shape of systematic robot error."""

from __future__ import annotations

import numpy as np

from calibrate.geometry import Array, difference
from calibrate.kinematics import MODELS, RobotModel, forward, link_frames
from calibrate.views import ViewSet

UNIT = 1e-3
"""θ = 1 means 1 mm for lengths and 1 mrad for angles: equal harm at an arm's length of 1 m."""
_SAME_M, _SAME_RAD = 0.02, np.radians(2.0)
"""Recorded joints and flange pose belong together when the table agrees within this."""


def kinematic_derivatives(views: ViewSet) -> Array | None:
    """(n, 6, 24) ∂flange/∂θ in base, columns a, d, alpha, theta of joints 1…6 times UNIT.

    None where joints or robot model are unknown, or do not belong to the flange poses.
    """
    model = MODELS.get(views.robot_model)
    if model is None or any(view.joints_rad is None for view in views):
        return None
    joints = np.array([view.joints_rad for view in views], dtype=float)
    if not np.isfinite(joints).all():
        return None
    miss = difference(forward(model, joints), views.base_from_flange)
    far = (np.linalg.norm(miss[:, :3], axis=1) > _SAME_M) | (np.linalg.norm(miss[:, 3:], axis=1) > _SAME_RAD)
    return None if far.any() else table_derivatives(model, joints)


def table_derivatives(model: RobotModel, joints_rad: Array) -> Array:
    """The same for joints (n, 6) of a known model.

    Standard convention: theta and d act about and along z of the frame before the joint, alpha and a about
    and along x of the frame after it.
    """
    frames = link_frames(model, joints_rad)
    z, before = frames[:, :6, :3, 2], frames[:, :6, :3, 3]
    x, after = frames[:, 1:, :3, 0], frames[:, 1:, :3, 3]
    flange = frames[:, 6:, :3, 3]
    zero = np.zeros_like(z)
    shift = np.concatenate([x, z, np.cross(x, flange - after), np.cross(z, flange - before)], axis=1)
    turn = np.concatenate([zero, zero, x, z], axis=1)
    return UNIT * np.swapaxes(np.concatenate([shift, turn], axis=-1), 1, 2)


def displacement_by_joint(derivatives: Array, theta: Array) -> Array:
    """(6,) root mean square shift of the flange, metres, that the errors at each joint make."""
    per_joint = (derivatives[:, :3] * theta).reshape(len(derivatives), 3, 4, 6).sum(axis=2)
    return np.asarray(np.sqrt((per_joint**2).sum(axis=1).mean(axis=0)))
