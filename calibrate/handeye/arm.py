"""Systematic errors of the arm and of a bracket that bends, to be estimated.

The arm is a chain of axes: learned from the recorded joints (`calibrate.arms.chain`), or a Universal Robots
table that the recorded flanges follow. Each link but the last has a shift and a turn as its error. Without
a chain, the flange itself has a shift and a turn that vary smoothly with its position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.arms.chain import Chain, LearnedChain, chain_of, learn_chain, read_otherwise, wrong_row
from calibrate.arms.kinematics import MODELS, RobotModel, inverse_many, with_near_axes
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, difference

FLEX = tuple(f"flex {row}{column}" for row in "xyz" for column in "xyz")
"""Names of a bracket's compliance, radians: turn about `row` for gravity along `column` of the flange."""


@dataclass(frozen=True, eq=False)
class ArmPostures:
    """Joint angles of the arm in every view, and the kinematics that they belong to."""

    chain: Chain
    """The arm as its controller computes it."""
    joints_rad: Array
    """(n, k)"""
    recorded: bool
    """True: measured. False: by inverse kinematics in one branch, which need not be the arm's real one."""
    table: RobotModel | None = None
    """The Universal Robots table that `chain` restates; None: the chain was learned."""


def arm_postures(views: ViewSet, used: NDArray[np.bool_]) -> tuple[ArmPostures | None, str]:
    """Read the recorded joints and find their kinematics: the table that the flanges follow, else learned.

    used: (n,) the views whose flanges have to follow. Without joints: one branch of inverse kinematics that
    reaches all recorded flanges. None where there are no joints and the robot's model is unknown, or neither
    a table nor a chain explains the flanges. The text says what is unusual about the joints.
    """
    flanges, joints = views.base_from_flange, recorded_joints(views)
    published, note = MODELS.get(views.robot_model), ""
    if joints is None and any(view.joints_rad is not None for view in views):
        note = "Poses lack joints, or some: none are used. Record them with every pose."
    model = None if published is None else with_near_axes(views.arm or published)
    if joints is not None:
        if model is not None and joints.shape[1] == 6:
            chain = chain_of(model)
            if LearnedChain(chain, difference(chain.forward(joints), flanges)[used]).explains:
                return ArmPostures(chain, joints, True, model), ""
        learned, joints, note = _learned(joints, views, used)
        if learned.explains:
            return ArmPostures(learned.chain, joints, True), note
    if published is None or model is None:
        return None, note
    found = joints_of_one_branch(published, flanges)
    return (None if found is None else ArmPostures(chain_of(model), found, False, model)), note


def _learned(joints: Array, views: ViewSet, used: NDArray[np.bool_]) -> tuple[LearnedChain, Array, str]:
    """Learn a chain from the used views: it, the joints as they were read, and what is unusual about them."""
    flanges = views.base_from_flange
    learned = learn_chain(joints[used], flanges[used])
    if learned.explains:
        return learned, joints, ""
    read = read_otherwise(joints, flanges, used)
    if read is not None:
        return (
            learn_chain(read[0][used], flanges[used]),
            read[0],
            f"The recorded joints fit the poses {read[1]}.",
        )
    shift, turn = learned.rms
    note = f"The recorded joints do not explain the poses ({1e3 * shift:.1f} mm, {np.degrees(turn):.1f}°). "
    row = wrong_row(learned, joints[used], flanges[used])
    if row is None:
        return learned, joints, note + "Check the order and unit of the joints."
    wrong = views.views[np.flatnonzero(used)[row]].index + 1
    return learned, joints, note + f"Without pose {wrong} they do: look at its joints."


def gravity_in_flange(flange: Array) -> Array:
    """Compute the direction of gravity (n, 3) in the flange; base's z is taken to point up."""
    return np.asarray(-flange[:, 2, :3])


def flex_motion(flange: Array, mean_gravity: Array | None = None) -> Array:
    """Compute the motion (n, 6, 9) of the flange, in base, by each entry of a bracket's compliance (3, 3).

    A bracket of camera (eye-in-hand) or board bends near the flange: it turns about the flange's origin by
    the compliance times the direction of gravity in the flange. The bend at `mean_gravity` (3,), None: the
    mean of the views, is subtracted: it belongs to X or Y.
    """
    R, gravity = flange[:, :3, :3], gravity_in_flange(flange)
    gravity = gravity - (gravity.mean(axis=0) if mean_gravity is None else mean_gravity)
    turn = R @ np.einsum("rk,nc->nkrc", np.eye(3), gravity).reshape(len(R), 3, 9)
    return np.concatenate([np.zeros_like(turn), turn], axis=1)


def flange_extent(flange: Array) -> Array:
    """Compute the mean place of the flange and its rms distance from there (4,), metres."""
    middle = flange[:, :3, 3].mean(axis=0)
    away = np.sqrt(((flange[:, :3, 3] - middle) ** 2).sum(axis=1).mean())
    return np.append(middle, max(float(away), 1e-9))


LINKS = 4.0
"""Errors of the flange as multiples of one link's: five links add up to √5, their levers to about as much
again. A power of two moves the sizes that are averaged over by whole steps, and X by nothing."""


def smooth_motion(flange: Array, extent: Array) -> Array:
    """Compute the motion (n, 6, 54) of the flange, in base, by the errors of an arm of unknown kinematics.

    Shift and turn are polynomials of second degree of the flange's position in `extent` (4,), as of
    `flange_extent`: three shifts, then three turns, for each of the nine terms, in units of a link's error.
    """
    place = (flange[:, :3, 3] - extent[:3]) / extent[3]
    i, j = np.triu_indices(3)
    terms = LINKS * np.concatenate([place, place[:, i] * place[:, j]], axis=1)
    return np.asarray(np.einsum("nk,ab->nakb", terms, np.eye(6)).reshape(len(flange), 6, -1))


def recorded_joints(views: ViewSet) -> Array | None:
    """Return the joints (n, k) of all views; None where a view has none, or another number of them."""
    given = [view.joints_rad for view in views if view.joints_rad is not None]
    if len(given) < len(views) or len({len(joints) for joints in given}) > 1:
        return None
    joints = np.array(given, dtype=float)
    return joints if np.isfinite(joints).all() else None


def joints_of_one_branch(model: RobotModel, flanges: Array) -> Array | None:
    """Find joints (n, 6) in one branch of inverse kinematics that reaches all flanges, else None.

    X comes out the same in any branch, as long as all views use the same one.
    """
    owner, joints, branch = inverse_many(model, flanges)
    for one in range(8):
        if np.array_equal(owner[branch == one], np.arange(len(flanges))):
            return np.asarray(joints[branch == one])
    return None
