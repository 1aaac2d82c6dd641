"""A plan in the terminal: the board in the pictures, the camera over the board, how the error falls."""

from __future__ import annotations

import numpy as np

from calibrate.boards.model import board_points
from calibrate.geometry import Array, transform_points
from calibrate.projection import project
from station.cell.plan import Plan
from station.cell.scene import Scene, flange_poses

_SHADES = " ░▒▓█"
_BARS = "▁▂▃▄▅▆▇█"
_WIDTH, _ROWS = 78, 11


def expected_pixels(scene: Scene, plan: Plan) -> Array:
    """Where every board point is expected in every picture, (n, k, 2) pixels; NaN behind the camera."""
    points = board_points(scene.board)
    seen = scene.seen(flange_poses(scene, plan), points)
    pixels = project(scene.camera, np.maximum(seen.reshape(-1, 3), [-np.inf, -np.inf, 1e-3])).pixels
    pixels[seen.reshape(-1, 3)[:, 2] <= 1e-3] = np.nan
    return pixels.reshape(len(seen), len(points), 2)


def coverage_grid(scene: Scene, plan: Plan, columns: int, rows: int) -> Array:
    """How many board points fall into each cell of the picture, (rows, columns)."""
    pixels = expected_pixels(scene, plan).reshape(-1, 2)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    size = scene.camera.width, scene.camera.height
    edges = [
        np.linspace(-0.5, side - 0.5, cells + 1) for side, cells in zip(size, (columns, rows), strict=True)
    ]
    counts = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=edges)[0]
    return np.asarray(counts.T)


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
            f"expected error of X  {bars}  {1000 * known[-1]:.2f} mm after {len(plan.poses)} poses"[:_WIDTH]
        )
    return "\n".join(lines)


def _picture_panel(scene: Scene, plan: Plan) -> list[str]:
    columns, rows = 34, _ROWS
    counts = coverage_grid(scene, plan, columns, rows)
    top = max(float(counts.max()), 1.0)
    shade = np.ceil((len(_SHADES) - 1) * counts / top).astype(int)
    body = ["│" + "".join(_SHADES[s] for s in row) + "│" for row in shade]
    empty = int((coverage_grid(scene, plan, 4, 4) == 0).sum())
    title = f"board points in the picture, {16 - empty}/16 filled"
    return [title, "┌" + "─" * columns + "┐", *body, "└" + "─" * columns + "┘"]


def _camera_panel(scene: Scene, plan: Plan) -> list[str]:
    columns, rows = 33, _ROWS
    """Camera centres over the board plane, numbered in order of visit."""
    centres = board_from_cameras(scene, plan)
    middle = transform_points(np.eye(4), board_points(scene.board)).mean(axis=0)
    offset = centres[:, :2] - middle[:2]
    reach = max(float(np.abs(offset).max()), 0.05)
    cells = [[" "] * columns for _ in range(rows)]
    cells[rows // 2][columns // 2] = "#"
    for number, (x, y) in enumerate(offset):
        row = round((y / reach + 1) / 2 * (rows - 1))
        column = round((x / reach + 1) / 2 * (columns - 2))
        for k, letter in enumerate(f"{number + 1}"):
            cells[row][min(column + k, columns - 1)] = letter
    title = f"camera over the board (#), ±{1000 * reach:.0f} mm"
    body = ["│" + "".join(row) + "│" for row in cells]
    return [title, "┌" + "─" * columns + "┐", *body, "└" + "─" * columns + "┘"]


def _bar(value: float, values: list[float]) -> str:
    low, high = np.log(min(values)), np.log(max(values))
    share = (np.log(value) - low) / max(high - low, 1e-9)
    return _BARS[round(float(share) * (len(_BARS) - 1))]
