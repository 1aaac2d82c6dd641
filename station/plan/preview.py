"""A plan as a picture file: arm, frusta and board in space; coverage and expected error beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from calibrate.geometry import Array, transform_points
from calibrate.projection import camera_matrix
from station.cell.collision import body_segments
from station.cell.errors import ConfigError
from station.cell.plan import Plan
from station.cell.scene import Scene, board_extent, flange_poses
from station.plan.sketch import expected_pixels

_FRUSTUM_M = 0.06
_SHOWN_ARMS = 3


def save_picture(scene: Scene, plan: Plan, path: Path) -> None:
    """Writes the preview as PNG, SVG or PDF, by the name's ending. ConfigError when that cannot be."""
    figure = Figure(figsize=(12, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.5, 1])
    _draw_space(figure.add_subplot(grid[:, 0], projection="3d"), scene, plan)
    _draw_coverage(figure.add_subplot(grid[0, 1]), scene, plan)
    _draw_error(figure.add_subplot(grid[1, 1]), plan)
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot write the picture {path}: {error}; name it something.png") from error


def _draw_space(axes: Any, scene: Scene, plan: Plan) -> None:
    flange = flange_poses(scene, plan)
    joints = np.array([pose.joints_rad for pose in plan.poses])
    for number in np.linspace(0, len(plan.poses) - 1, min(_SHOWN_ARMS, len(plan.poses))).astype(int):
        starts, ends, radii = body_segments(scene.geometry, joints[number][None])
        for start, end, radius in zip(starts[0], ends[0], radii, strict=True):
            axes.plot(
                *np.stack([start, end], axis=1),
                color="0.55",
                lw=160 * radius,
                alpha=0.25,
                solid_capstyle="round",
            )
    cameras = flange @ scene.X if scene.mount == "eye-in-hand" else scene.X[None]
    boards = scene.Y[None] if scene.mount == "eye-in-hand" else flange @ scene.Y
    for camera in cameras:
        for line in camera_frustum(scene, camera):
            axes.plot(*line.T, color="tab:blue", lw=0.8)
    for board in boards:
        outline = printed_outline(scene, board)
        axes.plot(*outline.T, color="k", lw=1.5 if len(boards) == 1 else 0.6)
    way = (cameras if len(cameras) > 1 else boards)[:, :3, 3]
    axes.plot(*way.T, color="tab:orange", lw=1.0)
    for number, point in enumerate(way):
        axes.text(*point, str(number + 1), fontsize=6)
    axes.set(
        xlabel="x m", ylabel="y m", zlabel="z m", title=f"{plan.robot}, {plan.mount}, {len(plan.poses)} poses"
    )
    everything = np.vstack([cameras[:, :3, 3], boards[:, :3, 3], np.zeros((1, 3))])
    middle, half = (
        (everything.max(0) + everything.min(0)) / 2,
        max(float(np.ptp(everything, axis=0).max()) / 2, 0.3),
    )
    for setter, centre in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        setter(centre - half, centre + half)
    axes.set_box_aspect((1, 1, 1))


def camera_frustum(scene: Scene, base_from_camera: Array) -> list[Array]:
    """Edges of the picture's pyramid, polylines (m, 3) in `base`."""
    K = camera_matrix(scene.camera)
    w, h = scene.camera.width, scene.camera.height
    rays = np.array([[u, v, 1.0] for u, v in ((0, 0), (w, 0), (w, h), (0, h))]) @ np.linalg.inv(K).T
    corners = transform_points(base_from_camera, _FRUSTUM_M * rays)
    centre = base_from_camera[:3, 3]
    return [np.vstack([corners, corners[:1]]), *(np.stack([centre, corner]) for corner in corners)]


def printed_outline(scene: Scene, base_from_board: Array) -> Array:
    """The printed area's outline, closed, (5, 3) in `base`."""
    low, high = board_extent(scene.board)
    flat = [(low[0], low[1], 0), (high[0], low[1], 0), (high[0], high[1], 0), (low[0], high[1], 0)]
    return transform_points(base_from_board, np.array([*flat, flat[0]], dtype=float))


def _draw_coverage(axes: Any, scene: Scene, plan: Plan) -> None:
    pixels = expected_pixels(scene, plan)
    for view in pixels:
        axes.plot(view[:, 0], view[:, 1], ".", ms=1.5)
    axes.set(xlim=(0, scene.camera.width), ylim=(scene.camera.height, 0), title="board points in the picture")
    axes.set_aspect("equal")


def _draw_error(axes: Any, plan: Plan) -> None:
    sigmas = [1000 * pose.predicted_sigma_m for pose in plan.poses if pose.predicted_sigma_m is not None]
    axes.set(xlabel="poses taken", title="expected error of the camera's place, mm (1σ)")
    if sigmas:
        axes.semilogy(range(1, len(sigmas) + 1), sigmas, "o-", ms=3)
        # The first two views say nothing about X; their bars would hide the rest.
        axes.set_ylim(0.7 * sigmas[-1], 1.5 * sigmas[min(2, len(sigmas) - 1)])
        axes.annotate(f"{sigmas[-1]:.2f} mm", (len(sigmas), 1.4 * sigmas[-1]), ha="right", va="bottom")
    axes.grid(True, which="both", alpha=0.3)
