"""A plan to look at: a picture file, a scene that other viewers play, a sketch in the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibrate.boards.model import board_points
from calibrate.geometry import Array, transform_points
from calibrate.projection import project
from recordings.scene import Colour, Entity, Polyline, write_scene
from station.cell.collision import body_segments
from station.cell.errors import ConfigError
from station.cell.limits import check_plan
from station.cell.plan import Plan
from station.cell.scene import Scene, flange_poses, frustum, printed_corners
from station.plan.visibility import count_in_parts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

_FRUSTUM_M = 0.06
_SHOWN_ARMS = 3
_SHADES = " ░▒▓█"
_BARS = "▁▂▃▄▅▆▇█"
_WIDTH, _ROWS = 78, 11
_ARM: Colour = (0.6, 0.6, 0.65, 0.8)
_CAMERA: Colour = (0.1, 0.4, 0.9, 1.0)
_BOARD: Colour = (0.1, 0.1, 0.1, 1.0)
_PATH: Colour = (1.0, 0.5, 0.0, 1.0)
_STEPS_PER_MOVE = 10


def save_picture(scene: Scene, plan: Plan, path: Path) -> None:
    """Writes the preview as PNG, SVG or PDF, by the name's ending. ConfigError when that cannot be."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import, seldom wanted
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.5, 1])
    _draw_space(figure.add_subplot(grid[:, 0], projection="3d"), scene, plan)
    _draw_coverage(figure.add_subplot(grid[0, 1]), scene, plan)
    _draw_error(figure.add_subplot(grid[1, 1]), plan)
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        text = f"cannot write the picture {path}: {error}"
        raise ConfigError(text, code="picture-not-written", remedy="Name it something.png.") from error


def _placed(scene: Scene, plan: Plan) -> tuple[Array, Array, Array]:
    """Cameras and boards, (n, 4, 4) or (1, 4, 4), and the path (n, 3) of what moves."""
    flange = flange_poses(scene, plan)
    in_hand = scene.mount == "eye-in-hand"
    cameras = flange @ scene.X if in_hand else scene.X[None]
    boards = scene.Y[None] if in_hand else flange @ scene.Y
    return cameras, boards, (cameras if len(cameras) > 1 else boards)[:, :3, 3]


def _draw_space(axes: Axes3D, scene: Scene, plan: Plan) -> None:
    cameras, boards, path = _placed(scene, plan)
    joints = np.array([pose.joints_rad for pose in plan.poses])
    for number in np.linspace(0, len(plan.poses) - 1, min(_SHOWN_ARMS, len(plan.poses))).astype(int):
        starts, ends, radii = body_segments(scene.geometry, joints[number][None])
        for start, end, radius in zip(starts[0], ends[0], radii, strict=True):
            look = {"color": "0.55", "lw": 160 * radius, "alpha": 0.25, "solid_capstyle": "round"}
            axes.plot(*np.stack([start, end], axis=1), **look)
    for camera in cameras:
        for line in camera_frustum(scene, camera):
            axes.plot(*line.T, color="tab:blue", lw=0.8)
    for board in boards:
        axes.plot(*printed_outline(scene, board).T, color="k", lw=1.5 if len(boards) == 1 else 0.6)
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


def camera_frustum(scene: Scene, base_from_camera: Array) -> list[Array]:
    """Edges of the image's pyramid, polylines (m, 3) in `base`."""
    points = frustum(scene.camera, base_from_camera, _FRUSTUM_M)
    return [points[[1, 2, 3, 4, 1]], *(points[[0, corner]] for corner in range(1, 5))]


def printed_outline(scene: Scene, base_from_board: Array) -> Array:
    """The printed area's outline, closed, (5, 3) in `base`."""
    return transform_points(base_from_board, printed_corners(scene.board)[[0, 1, 2, 3, 0]])


def _draw_coverage(axes: Axes, scene: Scene, plan: Plan) -> None:
    for view in expected_pixels(scene, plan):
        axes.plot(view[:, 0], view[:, 1], ".", ms=1.5)
    axes.set(xlim=(0, scene.camera.width), ylim=(scene.camera.height, 0), title="board points in the image")
    axes.set_aspect("equal")


def _draw_error(axes: Axes, plan: Plan) -> None:
    sigmas = [1000 * pose.predicted_sigma_m for pose in plan.poses if pose.predicted_sigma_m is not None]
    axes.set(xlabel="poses taken", title="expected error of the camera's position, mm (1σ)")
    if sigmas:
        axes.semilogy(range(1, len(sigmas) + 1), sigmas, "o-", ms=3)
        # The first two views say nothing about X; their bars would hide the rest.
        axes.set_ylim(0.7 * sigmas[-1], 1.5 * sigmas[min(2, len(sigmas) - 1)])
        axes.annotate(f"{sigmas[-1]:.2f} mm", (len(sigmas), 1.4 * sigmas[-1]), ha="right", va="bottom")
    axes.grid(True, which="both", alpha=0.3)


def expected_pixels(scene: Scene, plan: Plan) -> Array:
    """Predict every board point in every image, (n, k, 2) pixels; NaN behind the camera."""
    points = board_points(scene.board)
    seen = scene.seen(flange_poses(scene, plan), points)
    pixels = project(scene.camera, np.maximum(seen.reshape(-1, 3), [-np.inf, -np.inf, 1e-3])).pixels
    pixels[seen.reshape(-1, 3)[:, 2] <= 1e-3] = np.nan
    return pixels.reshape(len(seen), len(points), 2)


def coverage_grid(scene: Scene, plan: Plan, columns: int, rows: int) -> Array:
    """Counts the board points in each cell of the image, (rows, columns)."""
    pixels = expected_pixels(scene, plan).reshape(-1, 2)
    return count_in_parts(scene.camera, pixels[np.isfinite(pixels).all(axis=1)], rows, columns)


def board_from_cameras(scene: Scene, plan: Plan) -> Array:
    """Camera centres in `board`, (n, 3) metres; the viewer's side is z < 0."""
    seen = scene.camera_from_board(flange_poses(scene, plan))
    return np.asarray(-np.einsum("nji,nj->ni", seen[:, :3, :3], seen[:, :3, 3]))


def sketch(scene: Scene, plan: Plan) -> str:
    """Three small panels as lines of text, at most 78 wide."""
    left, right = _picture_panel(scene, plan), _camera_panel(scene, plan)
    lines = [f"{a:<40}{b}"[:_WIDTH] for a, b in zip(left, right, strict=True)]
    sigmas = [pose.predicted_sigma_m for pose in plan.poses]
    known = [s for s in sigmas if s is not None]
    if known:
        bars = "".join(_bar(s, known) for s in known)
        lines.append(
            f"expected camera pose error  {bars}  {1000 * known[-1]:.2f} mm after {len(plan.poses)} poses"[
                :_WIDTH
            ]
        )
    return "\n".join(lines)


def _picture_panel(scene: Scene, plan: Plan) -> list[str]:
    counts = coverage_grid(scene, plan, 34, _ROWS)
    shade = np.ceil((len(_SHADES) - 1) * counts / max(float(counts.max()), 1.0)).astype(int)
    empty = int((coverage_grid(scene, plan, 4, 4) == 0).sum())
    title = f"board points in the image, {16 - empty}/16 filled"
    return _framed(title, ["".join(_SHADES[s] for s in row) for row in shade])


def _camera_panel(scene: Scene, plan: Plan) -> list[str]:
    """Camera centres over the board plane, numbered in order of visit."""
    columns, rows = 33, _ROWS
    centres = board_from_cameras(scene, plan)
    offset = centres[:, :2] - board_points(scene.board).mean(axis=0)[:2]
    reach = max(float(np.abs(offset).max()), 0.05)
    cells = [[" "] * columns for _ in range(rows)]
    cells[rows // 2][columns // 2] = "#"
    for number, (x, y) in enumerate(offset):
        row = round((y / reach + 1) / 2 * (rows - 1))
        column = round((x / reach + 1) / 2 * (columns - 2))
        for k, letter in enumerate(f"{number + 1}"):
            cells[row][min(column + k, columns - 1)] = letter
    return _framed(f"camera over the board (#), ±{1000 * reach:.0f} mm", ["".join(row) for row in cells])


def _framed(title: str, rows: list[str]) -> list[str]:
    line = "─" * len(rows[0])
    return [title, f"┌{line}┐", *(f"│{row}│" for row in rows), f"└{line}┘"]


def _bar(value: float, values: list[float]) -> str:
    low, high = np.log(min(values)), np.log(max(values))
    share = (np.log(value) - low) / max(high - low, 1e-9)
    return _BARS[round(float(share) * (len(_BARS) - 1))]


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
    cameras, boards, path = _placed(scene, plan)
    frusta = tuple(
        Polyline(edge, _CAMERA, 0.001) for camera in cameras for edge in camera_frustum(scene, camera)
    )
    outlines = tuple(Polyline(printed_outline(scene, board), _BOARD, 0.002) for board in boards)
    return [Entity("plan", "base", (*frusta, *outlines, Polyline(path, _PATH, 0.002)))]


def _moving(scene: Scene, joints: Array, text: str) -> list[Entity]:
    starts, ends, radii = body_segments(scene.geometry, joints[None])
    arm = tuple(
        Polyline(np.stack([a, b]), _ARM, float(2 * r))
        for a, b, r in zip(starts[0], ends[0], radii, strict=True)
    )
    x, y, z = (float(v) for v in ends[0, 6] + [0.0, 0.0, 0.15])
    return [Entity("arm", "base", arm, text, (x, y, z))]
