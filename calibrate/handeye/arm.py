"""Systematic errors of the arm and of a bracket that bends, to be estimated.

The arm is a Universal Robots table where the recorded flanges follow one, else a chain learned from the
recorded joints (`calibrate.chain`): then each link but the last has a shift and a turn as its error.

Of the 24 errors of a table, eight look exactly like a change of X or of the board's pose: six of the first
and the last joint, and two of the three shifts along the parallel axes of joints 2, 3 and 4. These eight
stay at their nominal values. Two rotations of those axes about y (S. Hayati, 1983), which the table cannot
express, are added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.chain import Chain, LearnedChain, learn_chain, read_otherwise, wrong_row
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
    """Joint angles of the arm in every view, and the kinematics that they belong to."""

    arm: RobotModel | Chain
    """The nominal table, that the recorded flanges follow, or the chain learned from them."""
    joints_rad: Array
    """(n, k)"""
    recorded: bool
    """True: measured. False: by inverse kinematics in one branch, which need not be the arm's real one."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the errors."""
        return PARAMETERS if isinstance(self.arm, RobotModel) else link_errors(len(self.arm.axes))

    @property
    def unit(self) -> Array:
        """1σ (q,) of each error as a multiple of the common one."""
        return RELATIVE_SIGMA if isinstance(self.arm, RobotModel) else np.ones(len(self.names))

    def motion(self, joints_rad: Array) -> Array:
        """Compute the motion [δt, δφ] (m, 6, q) of the flange, in base, by each error, at joints (m, k)."""
        if isinstance(self.arm, RobotModel):
            return by_parameters(self.arm, joints_rad)
        return self.arm.by_links(joints_rad)

    def flanges(self, joints_rad: Array) -> Array:
        """Compute nominal base_from_flange (m, 4, 4)."""
        return (
            forward(self.arm, joints_rad)
            if isinstance(self.arm, RobotModel)
            else self.arm.forward(joints_rad)
        )


def link_errors(joints: int) -> tuple[str, ...]:
    """Name the errors of `Chain.by_links`, true minus nominal: shifts in metres, turns in radians."""
    return tuple(
        f"link {link} {kind} {axis}"
        for link in range(1, joints)
        for kind in ("shift", "turn")
        for axis in "xyz"
    )


def arm_postures(views: ViewSet) -> tuple[ArmPostures | None, str]:
    """Read the recorded joints and find their kinematics: the table that the flanges follow, else learned.

    Without joints: one branch of inverse kinematics that reaches all recorded flanges. None where there are
    no joints and the robot's model is unknown, or neither a table nor a chain explains the flanges. The text
    says what is unusual about the joints.
    """
    flanges, joints = views.base_from_flange, _recorded_joints(views)
    published, note = MODELS.get(views.robot_model), ""
    model = None if published is None else with_near_axes(views.arm or published)
    if joints is not None:
        if model is not None and joints.shape[1] == 6 and _agree(forward(model, joints), flanges):
            return ArmPostures(model, joints, True), ""
        learned, joints, note = _learned(joints, views)
        if learned.explains:
            return ArmPostures(learned.chain, joints, True), note
    if published is None or model is None:
        return None, note
    found = _joints_of_one_branch(published, flanges)
    return (None if found is None else ArmPostures(model, found, False)), note


def _learned(joints: Array, views: ViewSet) -> tuple[LearnedChain, Array, str]:
    """Learn a chain: it, the joints as they were read, and what is unusual about them."""
    flanges = views.base_from_flange
    learned = learn_chain(joints, flanges)
    if learned.explains:
        return learned, joints, ""
    read = read_otherwise(joints, flanges)
    if read is not None:
        return learn_chain(read[0], flanges), read[0], f"The recorded joints fit the poses {read[1]}."
    shift, turn = learned.rms
    note = f"The recorded joints do not explain the poses ({1e3 * shift:.1f} mm, {np.degrees(turn):.1f}°). "
    row = wrong_row(joints, flanges)
    if row is None:
        return learned, joints, note + "Check the order and unit of the joints."
    return learned, joints, note + f"Without pose {views.views[row].index + 1} they do: look at its joints."


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


def _recorded_joints(views: ViewSet) -> Array | None:
    given = [view.joints_rad for view in views if view.joints_rad is not None]
    if len(given) < len(views) or len({len(joints) for joints in given}) > 1:
        return None
    joints = np.array(given, dtype=float)
    return joints if np.isfinite(joints).all() else None


def _agree(computed: Array, recorded: Array) -> bool:
    miss = difference(computed, recorded)
    near = (np.linalg.norm(miss[:, :3], axis=1) <= _SAME_M) & (
        np.linalg.norm(miss[:, 3:], axis=1) <= _SAME_RAD
    )
    return bool(near.all())


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
