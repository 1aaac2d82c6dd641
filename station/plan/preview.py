"""Drawing of a plan as a file: cameras and board in space, board points in the image, expected error."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibrate.boards.model import board_points
from calibrate.geometry import Array, transform_points
from calibrate.projection import project
from station.cell.collision import body_segments
from station.cell.errors import ConfigError
from station.cell.layout import CellLayout, flange_poses, frustum, printed_corners
from station.cell.pose_plan import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

_FRUSTUM_M = 0.06
_SHOWN_ARMS = 3


def save_picture(layout: CellLayout, plan: Plan, path: Path) -> None:
    """Write the drawing as PNG, SVG or PDF, by the name's ending. ConfigError when it cannot be written."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import and rarely used
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.5, 1])
    _draw_space(figure.add_subplot(grid[:, 0], projection="3d"), layout, plan)
    _draw_coverage(figure.add_subplot(grid[0, 1]), layout, plan)
    _draw_error(figure.add_subplot(grid[1, 1]), plan)
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise ConfigError("picture-not-written", path=path, reason=str(error)) from error


def _placed(layout: CellLayout, plan: Plan) -> tuple[Array, Array, Array]:
    """Compute poses of cameras and boards, (n, 4, 4) or (1, 4, 4), and the path (n, 3) of the moving one."""
    flange = flange_poses(layout, plan)
    in_hand = layout.mount == "eye-in-hand"
    cameras = flange @ layout.X if in_hand else layout.X[None]
    boards = layout.Y[None] if in_hand else flange @ layout.Y
    return cameras, boards, (cameras if len(cameras) > 1 else boards)[:, :3, 3]


def _draw_space(axes: Axes3D, layout: CellLayout, plan: Plan) -> None:
    cameras, boards, path = _placed(layout, plan)
    joints = np.array([pose.joints_rad for pose in plan.poses])
    for number in np.linspace(0, len(plan.poses) - 1, min(_SHOWN_ARMS, len(plan.poses))).astype(int):
        starts, ends, radii = body_segments(layout.geometry, joints[number][None])
        for start, end, radius in zip(starts[0], ends[0], radii, strict=True):
            look = {"color": "0.55", "lw": 160 * radius, "alpha": 0.25, "solid_capstyle": "round"}
            axes.plot(*np.stack([start, end], axis=1), **look)
    for camera in cameras:
        for line in camera_frustum(layout, camera):
            axes.plot(*line.T, color="tab:blue", lw=0.8)
    for board in boards:
        axes.plot(*printed_outline(layout, board).T, color="k", lw=1.5 if len(boards) == 1 else 0.6)
    axes.plot(*path.T, color="tab:orange", lw=1.0)
    for number, point in enumerate(path):
        axes.text(*point, str(number + 1), fontsize=6)
    axes.set(
        xlabel="x m", ylabel="y m", zlabel="z m", title=f"{plan.robot}, {plan.mount}, {len(plan.poses)} poses"
    )
    everything = np.vstack([cameras[:, :3, 3], boards[:, :3, 3], np.zeros((1, 3))])
    middle = (everything.max(0) + everything.min(0)) / 2
    half = max(float(np.ptp(everything, axis=0).max()) / 2, 0.3)
    for setter, centre in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        setter(centre - half, centre + half)
    axes.set_box_aspect((1, 1, 1))


def camera_frustum(layout: CellLayout, base_from_camera: Array) -> list[Array]:
    """Make the edges of the camera's viewing pyramid: polylines (m, 3) in `base`."""
    points = frustum(layout.camera, base_from_camera, _FRUSTUM_M)
    return [points[[1, 2, 3, 4, 1]], *(points[[0, corner]] for corner in range(1, 5))]


def printed_outline(layout: CellLayout, base_from_board: Array) -> Array:
    """Make the closed outline (5, 3) of the printed area in `base`."""
    return transform_points(base_from_board, printed_corners(layout.board)[[0, 1, 2, 3, 0]])


def _draw_coverage(axes: Axes, layout: CellLayout, plan: Plan) -> None:
    for view in expected_pixels(layout, plan):
        axes.plot(view[:, 0], view[:, 1], ".", ms=1.5)
    axes.set(xlim=(0, layout.camera.width), ylim=(layout.camera.height, 0), title="board points in the image")
    axes.set_aspect("equal")


def _draw_error(axes: Axes, plan: Plan) -> None:
    sigmas = [1000 * pose.predicted_sigma_m for pose in plan.poses if pose.predicted_sigma_m is not None]
    axes.set(xlabel="poses taken", title="expected error of the camera's position, mm (1σ)")
    if sigmas:
        axes.semilogy(range(1, len(sigmas) + 1), sigmas, "o-", ms=3)
        # The first two views do not determine X; their large values would flatten the rest.
        axes.set_ylim(0.7 * sigmas[-1], 1.5 * sigmas[min(2, len(sigmas) - 1)])
        axes.annotate(f"{sigmas[-1]:.2f} mm", (len(sigmas), 1.4 * sigmas[-1]), ha="right", va="bottom")
    axes.grid(True, which="both", alpha=0.3)


def expected_pixels(layout: CellLayout, plan: Plan) -> Array:
    """Predict every board point in every image, (n, k, 2) pixels; NaN behind the camera."""
    points = board_points(layout.board)
    seen = layout.seen(flange_poses(layout, plan), points)
    pixels = project(layout.camera, np.maximum(seen.reshape(-1, 3), [-np.inf, -np.inf, 1e-3])).pixels
    pixels[seen.reshape(-1, 3)[:, 2] <= 1e-3] = np.nan
    return pixels.reshape(len(seen), len(points), 2)
