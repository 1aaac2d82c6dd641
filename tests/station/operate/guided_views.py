"""Views as a person would guide them, of a simulated cell: straight on, tilted three ways, turned."""

from __future__ import annotations

import numpy as np

from calibrate.arms.kinematics import MODELS, forward
from calibrate.boards.model import board_points
from calibrate.views.corners import Corners
from calibrate.views.view_set import BoardView, implied_flange
from recordings.geometry import Array, pose, rotation_exp, transform_points
from recordings.schema.messages import RobotIdentity
from station.cell.config import CameraChoice
from station.operate.draft import Draft
from station.simulation.truth import CellTruth
from tests.calibrate.cells import inverse_nearest
from tests.station.true_camera import board_seen, corners_seen

NEARER_M = (0.0, 0.02, -0.05, 0.06, 0.0)
TILTS = ((0.0, 0.0, 0.0), (0.45, 0.0, 0.1), (-0.2, 0.45, 0.0), (-0.3, -0.35, 0.3), (0.2, -0.4, -0.6))


def guided_joints(truth: CellTruth) -> list[Array]:
    """Joints (6,) near the start from which the camera sees the board tilted in several ways."""
    model = MODELS[truth.robot_model]
    X, Y = np.array(truth.camera_mount), np.array(truth.board_place)
    start = np.array(truth.start_joints_rad)
    first = board_seen(truth, forward(model, start))
    middle = transform_points(first, board_points(truth.board).mean(axis=0))
    found: list[Array] = []
    for tilt, nearer_m in zip(TILTS, NEARER_M, strict=True):
        R = rotation_exp(np.array(tilt))
        away = middle * (1 + nearer_m / middle[2])
        seen = pose(R, away - R @ middle) @ first
        wanted = implied_flange(truth.mount, X, Y, seen)
        joints = inverse_nearest(model, wanted, found[-1] if found else start)
        if joints is not None:
            found.append(np.asarray(joints))
    return found


def seen_by_hand(truth: CellTruth, joints: Array, index: int) -> BoardView:
    """Give what the true camera sees from there, with noise of 0.1 px."""
    flange = forward(MODELS[truth.robot_model], joints)
    pixels = corners_seen(truth, board_seen(truth, flange), np.random.default_rng(index))
    return BoardView(index, f"p{index}", flange, Corners(board_points(truth.board), pixels))


def draft_of(truth: CellTruth, views: int = 4) -> Draft:
    """The draft of a person who did everything right."""
    taken = [seen_by_hand(truth, q, k) for k, q in enumerate(guided_joints(truth)[:views])]
    return Draft(
        host="127.0.0.9",
        robot=RobotIdentity(model=truth.robot_model, serial="2026"),
        camera=CameraChoice("aravis", "SIM", "camera SIM"),
        width=truth.camera.width,
        height=truth.camera.height,
        mount=truth.mount,
        board=truth.board,
        views=tuple(taken),
    )
