"""A drawing of the cell: arm, what the camera sees from each pose, board, and where the arm must not go."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import product

import numpy as np
from textual.content import Content

from recordings.geometry import Array, transform_points
from station.cell.collision import body_segments
from station.cell.config import StationConfig
from station.cell.errors import StationError
from station.cell.layout import CellLayout, board_extent, frustum, layout_of
from station.cell.status import StationStatus
from station.tui.themes import few_signs
from station.tui.widgets.canvas import Canvas
from station.tui.words import dim

STYLES = ("$line", "$bad", "$accent", "$ok", "$strong", "bold $strong", "bold $warn")
FLOOR, KEEP_OUT, PLANNED, SAVED, ARM, BOARD, CHOSEN = range(1, 8)
"""Ranks on the canvas: the higher is drawn over the lower."""
LEGEND = "saved green, planned blue"
_SHORT_M = 0.07
"""Length of a frustum that is not the chosen one."""


@lru_cache(maxsize=4)
def _scene(config: StationConfig) -> CellLayout | None:
    try:
        return layout_of(config)
    except StationError:
        return None


def cell_scene(config: StationConfig | None, status: StationStatus) -> CellLayout | None:
    """Return the configured cell, camera and board where they were estimated.

    None without initial poses, and on a console, whose font has no braille.
    """
    if few_signs() or config is None or (scene := _scene(config)) is None:
        return None
    estimate = status.estimate
    if estimate.camera_pose is None or estimate.board_pose is None:
        return scene
    return replace(scene, X=np.array(estimate.camera_pose), Y=np.array(estimate.board_pose))


def draw(
    config: StationConfig | None, status: StationStatus, chosen: int | None, width: int, height: int
) -> Content:
    """Draw the cell. `chosen`: place in `session.poses`."""
    scene = cell_scene(config, status)
    if scene is None:
        return dim("No drawing: no initial poses are\nconfigured, or this console lacks signs.")
    poses = [(i, p) for i, p in enumerate(status.session.poses) if p.base_from_flange is not None]
    flange = {i: np.array(pose.base_from_flange) for i, pose in poses}
    joints = status.robot.joints_rad
    bodies = None if joints is None else body_segments(scene.geometry, np.array([joints]))
    board = np.array([*product(*zip(*board_extent(scene.board), strict=True), (0.0,))])
    in_hand = scene.mount == "eye-in-hand"
    still = transform_points(scene.Y if in_hand else scene.X, board if in_hand else np.zeros((1, 3)))
    ground = [np.zeros((1, 3)), still, *(T[None, :3, 3] for T in flange.values())]
    if bodies is not None:
        ground += [bodies[0][0], bodies[1][0]]
    everything = np.concatenate(ground)
    canvas = Canvas(width, height, everything)
    _surroundings(scene, everything, canvas)
    for i, pose in poses:
        rank = CHOSEN if i == chosen else SAVED if pose.counts else PLANNED
        if in_hand:
            far = scene.working_distance_m if i == chosen else _SHORT_M
            canvas.edges(frustum(scene.camera, flange[i] @ scene.X, far), _FRUSTUM, rank)
        else:
            canvas.edges(transform_points(flange[i] @ scene.Y, board), _QUAD, rank)
    if not in_hand:
        canvas.edges(frustum(scene.camera, scene.X, 2 * _SHORT_M), _FRUSTUM, BOARD)
        canvas.text(scene.X[:3, 3], "camera", BOARD)
    else:
        canvas.edges(still, [*_QUAD, (0, 3), (1, 2)], BOARD)
        canvas.text(still.mean(axis=0), "board", BOARD, (3, 0))
    if bodies is not None:
        for start, end, radius_m in zip(bodies[0][0], bodies[1][0], bodies[2], strict=True):
            canvas.rod(start, end, 0.8 * float(radius_m), ARM)
    if chosen is not None and chosen in flange:
        where = flange[chosen] @ (scene.X if in_hand else scene.Y)
        canvas.text(where[:3, 3], str(status.session.poses[chosen].index + 1), CHOSEN, (0, -1))
    return canvas.content(STYLES)


_QUAD = [(0, 1), (1, 3), (3, 2), (2, 0)]
_FRUSTUM = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]


def _surroundings(scene: CellLayout, everything: Array, canvas: Canvas) -> None:
    """Draw planes and the workspace's box, as large as what stands on them."""
    low, high = everything.min(axis=0) - 0.15, everything.max(axis=0) + 0.15
    limits = scene.geometry.limits
    for plane in limits.planes:
        point, normal = np.array(plane.point_m), np.array(plane.normal) / np.linalg.norm(plane.normal)
        level = abs(normal[2]) > 0.9
        axis = int(np.argmax(np.abs(normal)))
        across = [k for k in range(3) if k != axis]
        corners = np.zeros((4, 3))
        corners[:, across] = [*product(*zip(low[across], high[across], strict=True))]
        corners[:, axis] = (normal @ point - corners @ normal) / normal[axis]
        rank = FLOOR if level else KEEP_OUT
        canvas.edges(corners, _QUAD, rank, 0 if level else 3)
        canvas.text(corners[0] * 0.9 + corners[3] * 0.1, plane.name, rank)
    if limits.workspace_min_m is not None and limits.workspace_max_m is not None:
        sides = zip(limits.workspace_min_m, limits.workspace_max_m, strict=True)
        box = np.array([*product(*sides)])
        canvas.edges(box, _BOX, KEEP_OUT, 3)
        canvas.text(box[0], "workspace", KEEP_OUT)


_BOX = [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)]
