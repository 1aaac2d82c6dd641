"""Errors of the arm's Denavit-Hartenberg table and of a bracket that bends, to be estimated.

Of the 24 errors of a table, eight look exactly like a change of X or of the board's pose: six of the first
and the last joint, and two of the three shifts along the parallel axes of joints 2, 3 and 4. These eight
stay at their nominal values. Two rotations of those axes about y (S. Hayati, 1983), which the table cannot
express, are added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.geometry import Array, difference, skew
from calibrate.kinematics import MODELS, RobotModel, forward, inverse_many, link_frames, with_near_axes
from calibrate.views import ViewSet
from recordings.schema.messages import Mount

PARAMETERS = (
    *(f"a{joint}" for joint in range(1, 6)),
    *(f"d{joint}" for joint in (4, 5)),
    *(f"alpha{joint}" for joint in range(1, 6)),
    *(f"theta{joint}" for joint in range(2, 6)),
    "beta2",
    "beta3",
)
"""Names of the 18 errors, true minus nominal: a and d in metres, angles in radians."""
HELD = {
    **dict.fromkeys(("d1", "theta1"), "the place of the board, or of the camera beside the cell, takes it"),
    **dict.fromkeys(("a6", "d6", "alpha6", "theta6"), "the pose of what the flange carries takes it"),
    **dict.fromkeys(("d2", "d3"), "the axes of joints 2, 3 and 4 are parallel: only d2 + d3 + d4 counts"),
}
"""The other errors of a table, and why each is held at its nominal value."""
FLEX = tuple(f"flex {row}{column}" for row in "xyz" for column in "xyz")
"""Names of a bracket's compliance, radians: turn about `row` for gravity along `column` of the flange."""
RELATIVE_SIGMA = np.array([3**0.5 if name == "d4" else 1.0 for name in PARAMETERS])
"""1σ of each error as a multiple of the common one; larger for d4, which stands for d2 + d3 + d4."""
_SAME_M, _SAME_RAD = 0.02, float(np.radians(2.0))
"""Recorded joints and flange belong together when the nominal table agrees within this."""


@dataclass(frozen=True, eq=False)
class ArmPostures:
    """Joint angles of the arm in every view, and the kinematic table that they belong to."""

    model: RobotModel
    """The nominal table, that the recorded flanges follow."""
    joints_rad: Array
    """(n, 6)"""
    recorded: bool
    """True: measured. False: by inverse kinematics in one branch, which need not be the arm's real one."""


def arm_postures(views: ViewSet) -> ArmPostures | None:
    """Read the recorded joints, else find one branch of inverse kinematics that reaches all recorded flanges.

    None where the robot's model is unknown or its nominal table does not reach the flanges.
    """
    published = MODELS.get(views.robot_model)
    if published is None:
        return None
    model = published if views.arm is None else with_near_axes(views.arm)
    joints = _recorded_joints(views, model)
    if joints is not None:
        return ArmPostures(model, joints, True)
    joints = _joints_of_one_branch(published, views.base_from_flange)
    return None if joints is None else ArmPostures(model, joints, False)


def corrected_model(nominal: RobotModel, errors: Array) -> RobotModel:
    """Add errors (18,), in the order of `PARAMETERS`, to a table."""
    named = dict(zip(PARAMETERS, errors.tolist(), strict=True))

    def column(kind: str) -> tuple[float, ...]:
        return tuple(named.get(f"{kind}{joint}", 0.0) for joint in range(1, 7))

    return nominal.calibrated(*(column(kind) for kind in ("a", "d", "alpha", "theta", "beta")))


def flex_motion(mount: Mount, flange: Array, held: Array) -> Array:
    """Compute the motion (n, 6, 9) of the flange, in base, by each entry of a bracket's compliance (3, 3).

    The bracket carries the camera (eye-in-hand) or the board at `held` (4, 4) in the flange. It bends by the
    compliance times the direction of gravity in the flange. The mean bend over the views is subtracted: it
    belongs to X or Y. Base's z is taken to point up.
    """
    R = flange[:, :3, :3]
    gravity = -R[:, 2, :]
    gravity = gravity - gravity.mean(axis=0)
    turn = np.einsum("rk,nc->nkrc", np.eye(3), gravity).reshape(len(R), 3, 9)
    return np.concatenate([-R @ skew(held[:3, 3]) @ turn, -R @ turn], axis=1)


def _recorded_joints(views: ViewSet, model: RobotModel) -> Array | None:
    if any(view.joints_rad is None for view in views):
        return None
    joints = np.array([view.joints_rad for view in views], dtype=float)
    if not np.isfinite(joints).all():
        return None
    miss = difference(forward(model, joints), views.base_from_flange)
    far = (np.linalg.norm(miss[:, :3], axis=1) > _SAME_M) | (np.linalg.norm(miss[:, 3:], axis=1) > _SAME_RAD)
    return None if far.any() else joints


def _joints_of_one_branch(model: RobotModel, flanges: Array) -> Array | None:
    """Find joints (n, 6) in one branch of inverse kinematics that reaches all flanges, else None.

    X comes out the same in any branch, as long as all views use the same one.
    """
    owner, joints, branch = inverse_many(model, flanges)
    for one in range(8):
        if np.array_equal(owner[branch == one], np.arange(len(flanges))):
            return np.asarray(joints[branch == one])
    return None


def by_parameters(model: RobotModel, joints_rad: Array) -> Array:
    """Compute the motion [δt, δφ] (n, 6, 18) of the flange, in base, by each of `PARAMETERS`.

    model: a table made by `kinematics.with_near_axes`; joints_rad: (n, 6). Standard convention: theta and d
    act about and along z of the frame before the joint; alpha and a about and along x, beta about y, of the
    frame after it.
    """
    frames = link_frames(model, joints_rad)
    z, before = frames[:, :6, :3, 2], frames[:, :6, :3, 3]
    x, y, after = frames[:, 1:, :3, 0], frames[:, 1:, :3, 1], frames[:, 1:, :3, 3]
    flange = frames[:, 6:, :3, 3]
    zero = np.zeros_like(z)
    columns = {
        "a": (x, zero),
        "d": (z, zero),
        "alpha": (np.cross(x, flange - after), x),
        "theta": (np.cross(z, flange - before), z),
        "beta": (np.cross(y, flange - after), y),
    }
    motion = np.zeros((len(joints_rad), 6, len(PARAMETERS)))
    for place, name in enumerate(PARAMETERS):
        shift, turn = columns[name[:-1]]
        joint = int(name[-1]) - 1
        motion[:, :3, place], motion[:, 3:, place] = shift[:, joint], turn[:, joint]
    return motion
