"""A UR10 whose Denavit-Hartenberg table is wrong: its views, and poses that took no part."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.imperfect_cells import table_errors
from benchmarks.scene import LOW, PAPER_X, grid, make_cell, view_set
from benchmarks.trials import rms
from calibrate.geometry import Array, difference, inverse, perturb, pose, rotation_exp
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.kinematics import MODELS, forward
from calibrate.projection import project
from calibrate.views import ViewSet
from tests.calibrate.cells import inverse_nearest

_MODEL = MODELS["UR10"]
_HOME = (0.0, -1.5, 1.5, -1.5, -1.5, 0.0)


@dataclass(frozen=True, eq=False)
class Worn:
    views: ViewSet
    new_joints: Array
    """(25, 6) poses that took no part."""
    new_board_poses: Array
    """Their true board poses."""
    X: Array
    flange_error_m: float
    """rms over the views, a constant offset removed."""


def worn_cell(rng: np.random.Generator, size_mm: float) -> Worn:
    """Errors of the table of this size: mm for lengths, mrad for angles."""
    joints, Y = _reachable(rng, 50)
    true = forward(_MODEL.calibrated(*table_errors(rng, size_mm)), joints)
    C = inverse(PAPER_X) @ inverse(true) @ Y
    error = difference(true, forward(_MODEL, joints))[:, :3]
    camera, board = make_cell(rng, 1, MeasurementNoise(0, 0, 0)).camera, grid(7, 6, 0.025)
    seen = project(camera, board @ np.swapaxes(C[:25, :3, :3], 1, 2) + C[:25, None, :3, 3]).pixels
    pixels = seen + LOW.corner_px * rng.normal(size=seen.shape)
    repeatability = rng.normal(size=(25, 6)) * np.repeat([LOW.robot_m, LOW.robot_rad], 3)
    views = view_set(
        perturb(forward(_MODEL, joints[:25]), repeatability), board, pixels, camera, "eye-in-hand"
    )
    with_joints = tuple(replace(view, joints_rad=q) for view, q in zip(views, joints[:25], strict=True))
    views = replace(views, views=with_joints, robot_model="UR10")
    return Worn(views, joints[25:], C[25:], PAPER_X, rms(np.linalg.norm(error - error.mean(axis=0), axis=1)))


def _reachable(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Joints (count, 6) that look at a board lying in front of the arm, and base_from_board."""
    while True:
        C = make_cell(rng, 2 * count, MeasurementNoise(0, 0, 0), with_pnp=False).C
        turn = rotation_exp([np.pi, 0, 0]) @ rotation_exp([0, 0, rng.uniform(-np.pi, np.pi)])
        Y = pose(turn, [rng.uniform(0.5, 0.8), rng.uniform(-0.3, 0.3), rng.uniform(-0.1, 0.1)])
        found = [inverse_nearest(_MODEL, flange, _HOME) for flange in Y @ inverse(C) @ inverse(PAPER_X)]
        joints = [q for q in found if q is not None]
        if len(joints) >= count:
            return np.array(joints[:count]), Y
