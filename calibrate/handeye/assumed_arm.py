"""An arm of which nobody told the joints, as a typical arm of its class.

What such an arm does wrong at its flange can be told in part only: its mean error over the workspace is in no
residual. So a typical arm stands in for it: the links of a Universal Robots arm, scaled until it reaches all
recorded flanges, with errors of the size that is published for the class. The fit of that arm says how far X,
and a point placed by it, may be off; X itself stays where the flanges as they are told have it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.arms.chain import chain_of
from calibrate.arms.classes import ArmClass, arm_class
from calibrate.arms.kinematics import MODELS, RobotModel
from calibrate.handeye.arm import ArmPostures, joints_of_one_branch, recorded_joints
from calibrate.handeye.workspace import sample_workspace
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, skew

_TYPICAL = replace(MODELS["UR10"], d_m=(0.1273, 0.0, 0.0, 0.0, 0.1157, 0.0922))
"""A UR10 whose links are in one plane with its first axis, so that it reaches past that axis, too."""
_SCALES = (0.45, 0.6, 0.8, 1.0, 1.25, 1.6, 2.0, 2.5, 3.2)
"""Sizes of the typical arm that are tried, the smallest that reaches all flanges is taken."""
_LEAST_SHIFT_SHARE = 0.1
"""Least part of the class's error of position that the shifts of the links make; the turns make the rest."""
_MM = 1e3


TOLD = "told"
"""Name of a class of one: an arm whose own accuracy was told."""


def class_of_arm(views: ViewSet, told_class: str, shift_m: float | None, turn_rad: float | None) -> ArmClass:
    """Say how far this arm may be off: what was told of it, else by its class, its model or its joints.

    shift_m, turn_rad: 1σ per axis, as told; of the turn None: 1 mrad for each mm.
    """
    joints = recorded_joints(views)
    usual = arm_class(views.robot_model, told_class, None if joints is None else joints.shape[1])
    if not shift_m:
        return usual
    return replace(
        usual,
        name=TOLD,
        shift_m=shift_m,
        turn_rad=shift_m if turn_rad is None else turn_rad,
        source="Told of this very arm.",
    )


def assumed_postures(base_from_flange: Array) -> ArmPostures | None:
    """Find a typical arm that reaches all flanges (n, 4, 4), and its joints there; None where none does."""
    for scale in _SCALES:
        model = _scaled(_TYPICAL, scale)
        joints = joints_of_one_branch(model, base_from_flange)
        if joints is not None:
            return ArmPostures(chain_of(model), joints, recorded=False, table=model)
    return None


def _scaled(model: RobotModel, scale: float) -> RobotModel:
    larger = np.multiply(scale, [model.a_m, model.d_m])
    a_m, d_m = (tuple(row) for row in larger.tolist())
    return replace(model, a_m=a_m, d_m=d_m, name="")


@dataclass(frozen=True)
class LinkSizes:
    """1σ of the errors of an arm's links, as its class has them."""

    shift_mm: float
    turn_mrad: float


def link_sizes(arm: ArmPostures, of_class: ArmClass) -> LinkSizes:
    """Find the errors of links with which the flange is as far off, over the workspace, as in this class.

    The flange moves by Σ B_k ε_k (`Chain.by_links`): of links with independent errors its variance is the sum
    of those of shifts and turns, each in proportion to the square of its size. Who measures an arm's accuracy
    of position registers its base first: what moves all postures as one body is not in the class's figure,
    though it is in the links, and in the pose of a fixed camera.
    """
    joints = arm.joints_rad if arm.table is None else sample_workspace(arm.table, arm.joints_rad)
    motion = arm.chain.by_links(joints)
    turned = motion[:, 3:]
    shifted = _beside_registration(arm.chain.forward(joints)[:, :3, 3], motion[:, :3])
    kind = np.arange(motion.shape[2]) % 6
    by_shift = kind < 3
    by_turn = kind >= 3
    turn = of_class.turn_rad / np.sqrt(_mean_square(turned[..., by_turn]))
    left = of_class.shift_m**2 - turn**2 * _mean_square(shifted[..., by_turn])
    least = (_LEAST_SHIFT_SHARE * of_class.shift_m) ** 2
    shift = np.sqrt(max(left, least) / _mean_square(shifted[..., by_shift]))
    return LinkSizes(float(_MM * shift), float(_MM * turn))


def _beside_registration(place: Array, shifted: Array) -> Array:
    """Take off the shifts (n, 3, q) what the best rigid motion of base makes of them, at places (n, 3)."""
    eye = np.broadcast_to(np.eye(3), (len(place), 3, 3))
    by_base = np.concatenate([eye, -skew(place)], axis=2).reshape(-1, 6)
    rows = shifted.reshape(len(by_base), -1)
    left = rows - by_base @ np.linalg.lstsq(by_base, rows, rcond=None)[0]
    return np.asarray(left.reshape(shifted.shape))


def _mean_square(motion: Array) -> float:
    """Average, over postures and three axes, the square of (n, 3, q) summed over the errors."""
    return float((motion**2).sum(axis=2).mean())
