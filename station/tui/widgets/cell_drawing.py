"""A drawing of the cell: arm, what the camera sees from each pose, board, and where the arm must not go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import product

import msgspec
import numpy as np
from textual.content import Content

from calibrate.geometry import Array, transform_points
from station.cell.collision import body_segments
from station.cell.config import StationConfig
from station.cell.errors import StationError
from station.cell.layout import CellLayout, board_extent, frustum, layout_of
from station.cell.status import StationStatus
from station.tui.themes import few_signs
from station.tui.widgets.canvas import Canvas

STYLES = ("$line", "$bad", "$accent", "$ok", "$strong", "bold $strong", "bold $warn")
FLOOR, KEEP_OUT, PLANNED, SAVED, ARM, BOARD, CHOSEN = range(1, 8)
"""Ranks on the canvas: the higher is drawn over the lower."""
LEGEND = "saved green, planned blue"
_TURN_DEG, _LIFT_DEG = -60.0, 22.0
"""Direction of view about the base's z axis, and height of the eye above the floor."""
_SHORT_M = 0.07
"""Length of a frustum that is not the chosen one."""


@lru_cache(maxsize=4)
def _scene(encoded: bytes) -> CellLayout | None:
    try:
        return layout_of(msgspec.json.decode(encoded, type=StationConfig))
    except StationError:
        return None


def cell_scene(config: StationConfig | None, status: StationStatus) -> CellLayout | None:
    """Return the configured cell, camera and board where they were estimated.

    None without initial poses, and on a console, whose font has no braille.
    """
    if few_signs() or config is None or (scene := _scene(msgspec.json.encode(config))) is None:
        return None
    estimate = status.estimate
    if estimate.camera_pose is None or estimate.board_pose is None:
        return scene
    return replace(scene, X=np.array(estimate.camera_pose), Y=np.array(estimate.board_pose))


def draw(
    scene: CellLayout,
    status: StationStatus,
    chosen: int | None,
    width: int,
    height: int,
) -> Content:
    """Draw the cell. `chosen`: place in `session.poses`."""
    canvas = Canvas(width, height)
    turn, lift = np.radians([_TURN_DEG, _LIFT_DEG])
    right = np.array([-np.sin(turn), np.cos(turn), 0.0])
    up = np.array([-np.cos(turn) * np.sin(lift), -np.sin(turn) * np.sin(lift), np.cos(lift)])
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
    flat = np.stack([everything @ right, everything @ up], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    across, tall = np.maximum(high - low, 0.2)
    scale = 0.86 * min(canvas.width / across, canvas.height / tall)
    middle = (low + high) / 2

    def place(points: Array) -> Array:
        at = (np.stack([points @ right, points @ up], axis=-1) - middle) * scale
        return np.stack([canvas.width / 2 + at[..., 0], canvas.height / 2 - at[..., 1]], axis=-1)

    def edges(points: Array, pairs: list[tuple[int, int]], rank: int, dash: int = 0) -> None:
        at = place(points)
        canvas.lines(at[[a for a, _ in pairs]], at[[b for _, b in pairs]], rank, dash)

    _surroundings(scene, everything, edges, lambda at, words, rank: canvas.text(place(at), words, rank))
    for i, pose in poses:
        rank = CHOSEN if i == chosen else SAVED if pose.counts else PLANNED
        if in_hand:
            far = scene.working_distance_m if i == chosen else _SHORT_M
            edges(frustum(scene.camera, flange[i] @ scene.X, far), _FRUSTUM, rank)
        else:
            edges(transform_points(flange[i] @ scene.Y, board), _QUAD, rank)
    if not in_hand:
        edges(frustum(scene.camera, scene.X, 2 * _SHORT_M), _FRUSTUM, BOARD)
        canvas.text(place(scene.X[:3, 3]), "camera", BOARD)
    else:
        edges(still, [*_QUAD, (0, 3), (1, 2)], BOARD)
        canvas.text(place(still.mean(axis=0)) + np.array([6, 0]), "board", BOARD)
    if bodies is not None:
        for start, end, radius in zip(bodies[0][0], bodies[1][0], bodies[2], strict=True):
            canvas.rod(place(start), place(end), float(radius) * scale * 0.8, ARM)
    if chosen is not None and chosen in flange:
        where = flange[chosen] @ (scene.X if in_hand else scene.Y)
        canvas.text(
            place(where[:3, 3]) - np.array([0, 4]), str(status.session.poses[chosen].index + 1), CHOSEN
        )
    return canvas.content(STYLES)


_QUAD = [(0, 1), (1, 3), (3, 2), (2, 0)]
_FRUSTUM = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]


Edges = Callable[[Array, list[tuple[int, int]], int, int], None]


def _surroundings(
    scene: CellLayout, everything: Array, edges: Edges, text: Callable[[Array, str, int], None]
) -> None:
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
        edges(corners, _QUAD, rank, 0 if level else 3)
        text(corners[0] * 0.9 + corners[3] * 0.1, plane.name, rank)
    if limits.workspace_min_m is not None and limits.workspace_max_m is not None:
        sides = zip(limits.workspace_min_m, limits.workspace_max_m, strict=True)
        box = np.array([*product(*sides)])
        edges(box, _BOX, KEEP_OUT, 3)
        text(box[0], "workspace", KEEP_OUT)


_BOX = [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)]
