"""Poses in words and numbers: what the board is expected to look like, and why a pose is there."""

from __future__ import annotations

import cv2
import numpy as np

from calibrate.boards.model import board_points
from calibrate.geometry import Array
from calibrate.projection import project
from station.cell.plan import ExpectedView, PlannedPose
from station.cell.scene import Scene, board_extent


def expected_view(scene: Scene, base_from_flange: Array) -> ExpectedView:
    """How the board should look from a flange pose (4, 4), by the scene's guess."""
    camera_from_board = scene.camera_from_board(base_from_flange)
    points = board_points(scene.board)
    low, high = board_extent(scene.board)
    outline = np.array(
        [[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]]
    )
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    R, t = camera_from_board[:3, :3], camera_from_board[:3, 3]
    seen = np.vstack([centre, outline]) @ R.T + t
    pixels = project(scene.camera, np.maximum(seen, [-np.inf, -np.inf, 0.02])).pixels
    area = abs(float(cv2.contourArea(pixels[1:].astype(np.float32))))
    return ExpectedView(
        distance_m=float(np.linalg.norm(seen[0])),
        tilt_rad=float(np.arccos(np.clip(R[2, 2], -1, 1))),
        # About the optical axis, after the tilt's shortest turn is taken off.
        roll_rad=float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])),
        centre_px=(float(pixels[0, 0]), float(pixels[0, 1])),
        coverage=min(1.0, area / (scene.camera.width * scene.camera.height)),
    )


def planned_pose(
    scene: Scene, number: int, joints_rad: Array, base_from_flange: Array, sigma_m: float | None
) -> PlannedPose:
    """A pose of the plan with its expected view and the reason in a few words."""
    view = expected_view(scene, base_from_flange)
    j = [float(angle) for angle in joints_rad]
    return PlannedPose(
        name=f"p{number + 1:02d}",
        joints_rad=(j[0], j[1], j[2], j[3], j[4], j[5]),
        base_from_flange=tuple(tuple(float(x) for x in row) for row in base_from_flange),
        view=view,
        why=_why(scene, view),
        predicted_sigma_m=sigma_m,
    )


def _why(scene: Scene, view: ExpectedView) -> str:
    half = np.array([scene.camera.width, scene.camera.height]) / 2
    x, y = (np.array(view.centre_px) - half) / half
    side = " ".join(
        word
        for word, on in (("up", y < -0.1), ("down", y > 0.1), ("left", x < -0.1), ("right", x > 0.1))
        if on
    )
    return (
        f"{1000 * view.distance_m:.0f} mm, tilt {np.rad2deg(view.tilt_rad):.0f}°, "
        f"roll {np.rad2deg(view.roll_rad):+.0f}°, board {side or 'centred'}"
    )
