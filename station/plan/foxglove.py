"""The plan as a scene file for Foxglove, Lichtblick or rerun: the arm walks through its poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibrate.geometry import Array
from recordings.scene import Colour, Entity, Line, write_scene
from station.cell.collision import body_segments
from station.cell.limits import check_plan
from station.cell.plan import Plan
from station.cell.scene import Scene, flange_poses
from station.plan.preview import camera_frustum, printed_outline

_ARM: Colour = (0.6, 0.6, 0.65, 0.8)
_CAMERA: Colour = (0.1, 0.4, 0.9, 1.0)
_BOARD: Colour = (0.1, 0.1, 0.1, 1.0)
_WAY: Colour = (1.0, 0.5, 0.0, 1.0)
_STEPS_PER_MOVE = 10


def save_scene(scene: Scene, plan: Plan, path: Path) -> None:
    """Writes an MCAP in which the planned motion plays at its planned pace. RecordingError when it cannot."""
    steps: list[tuple[float, list[Entity]]] = [(0.0, _fixed(scene, plan))]
    seconds = 0.0
    moves = check_plan(plan, None, scene.geometry).moves
    for number, pose in enumerate(plan.poses):
        before = plan.poses[max(number - 1, 0)].joints_rad
        for share in np.linspace(0, 1, _STEPS_PER_MOVE + 1)[1:]:
            joints = np.array(before) + share * (np.array(pose.joints_rad) - before)
            now = seconds + share * moves[number].duration_s
            steps.append((now, _moving(scene, joints, f"{number + 1} {pose.why}")))
        seconds += moves[number].duration_s + 0.5
    write_scene(path, steps)


def _fixed(scene: Scene, plan: Plan) -> list[Entity]:
    flange = flange_poses(scene, plan)
    cameras = flange @ scene.X if scene.mount == "eye-in-hand" else scene.X[None]
    boards = scene.Y[None] if scene.mount == "eye-in-hand" else flange @ scene.Y
    frusta = tuple(Line(edge, _CAMERA, 0.001) for camera in cameras for edge in camera_frustum(scene, camera))
    outlines = tuple(Line(printed_outline(scene, board), _BOARD, 0.002) for board in boards)
    way = (cameras if len(cameras) > 1 else boards)[:, :3, 3]
    return [Entity("plan", "base", (*frusta, *outlines, Line(way, _WAY, 0.002)))]


def _moving(scene: Scene, joints: Array, text: str) -> list[Entity]:
    starts, ends, radii = body_segments(scene.geometry, joints[None])
    arm = tuple(
        Line(np.stack([a, b]), _ARM, float(2 * r)) for a, b, r in zip(starts[0], ends[0], radii, strict=True)
    )
    x, y, z = (float(v) for v in ends[0, 6] + [0.0, 0.0, 0.15])
    return [Entity("arm", "base", arm, text, (x, y, z))]
