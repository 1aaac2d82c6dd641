"""Renderer of images of a board for a camera with a known lens.

The ray of every pixel is traced through the lens to the board. No texture is warped, so corners are exactly
where `cv2.projectPoints` puts them. Pixels with an edge are averages of sub-pixel samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.printing import draw_pattern, origin_mm
from calibrate.views.projection import camera_matrix, undistort
from recordings.geometry import Array
from recordings.schema.messages import BoardSpec, CameraModel
from station.simulation.truth import Light as Light

Floats = NDArray[np.float32]
BLACK, WHITE = 0.05, 0.85
"""Albedo of the print"""
TABLE_ALBEDO = 0.30
FULL_SCALE_US = 10_000.0
"""Exposure at which albedo 1 in the image's centre gives WHITE_LEVEL, at gain 0 dB and illumination 1."""
WHITE_LEVEL = 235.0
BLACK_LEVEL = 3.0
VIGNETTING = 0.18
"""Share of light lost in the image's corners."""
_SAMPLES, _STRIDE = 13, 5
"""Sub-pixel samples of a pixel with an edge, on a Fibonacci lattice, so that no two share a row or column.
On a square grid an edge along a row would pass all its samples at once: an error of 0.06 px with 4×4."""


@dataclass(frozen=True, eq=False)
class BoardPrint:
    """Print of a board, as `calibrate board` draws it, on a white sheet: albedo as a function of position.

    Origin and axes are those of the board's points. Positions are metres, arrays of one shape.
    """

    sheet_m: tuple[float, float, float, float]
    """x0, y0, x1, y1 of the white sheet"""
    columns_m: Floats
    """Every x at which a rectangle begins or ends"""
    rows_m: Floats
    black: NDArray[np.bool_]
    """(rows + 1, columns + 1): what is black between these lines, and beyond them"""
    circles_m: Floats
    """(n, 3) x, y, radius"""

    def albedo(self, x_m: Floats, y_m: Floats, around: float) -> Floats:
        """Compute the albedo at positions; `around`: that beyond the sheet."""
        column = np.searchsorted(self.columns_m, x_m, side="right")
        row = np.searchsorted(self.rows_m, y_m, side="right")
        inked = self.black[row, column]
        for x, y, radius in self.circles_m:
            inked |= (x_m - x) ** 2 + (y_m - y) ** 2 < radius**2
        x0, y0, x1, y1 = self.sheet_m
        on_sheet = (x_m >= x0) & (x_m <= x1) & (y_m >= y0) & (y_m <= y1)
        value = np.where(inked, np.float32(BLACK), np.float32(WHITE))
        return np.where(on_sheet, value, np.float32(around))


@lru_cache(maxsize=8)
def board_print(board: BoardSpec) -> BoardPrint:
    """Make the print of a board with a white margin of half a square around the pattern."""
    rectangles, circles, width, height = draw_pattern(board)
    right, down = origin_mm(board, height)
    margin = 500 * board.square_m
    sheet = (-right - margin, -down - margin, width - right + margin, height - down + margin)
    corners = rectangles[:, [0, 1, 0, 1]] + np.pad(rectangles[:, 2:], ((0, 0), (2, 0))) - [right, down] * 2
    columns, ends_x = np.unique(np.round(corners[:, [0, 2]], 6), return_inverse=True)
    rows, ends_y = np.unique(np.round(corners[:, [1, 3]], 6), return_inverse=True)
    black = np.zeros((len(rows) + 1, len(columns) + 1), dtype=bool)
    for (left, end), (top, bottom) in zip(ends_x.reshape(-1, 2), ends_y.reshape(-1, 2), strict=True):
        black[top + 1 : bottom + 1, left + 1 : end + 1] = True
    x0, y0, x1, y1 = (1e-3 * edge for edge in sheet)
    metres = [(1e-3 * found).astype(np.float32) for found in (columns, rows, circles - [right, down, 0])]
    return BoardPrint((x0, y0, x1, y1), metres[0], metres[1], black, metres[2])


@dataclass(frozen=True, eq=False)
class _LensTable:
    """Ray (x, y, 1) of each pixel's centre, its slopes, and the vignetting: (height, width) each."""

    x: Floats
    y: Floats
    x_slopes: tuple[Floats, Floats]
    """Of x: to the next pixel down, and to the right."""
    y_slopes: tuple[Floats, Floats]
    vignetting: Floats


def render(
    camera: CameraModel,
    board: BoardSpec,
    camera_from_board: Array,
    light: Light | None = None,
    rng: np.random.Generator | None = None,
) -> NDArray[np.uint8]:
    """Render a mono8 image (height, width); `camera_from_board` (4, 4) at mid-exposure.

    Without `rng` the image is free of noise. The camera needs a matrix.
    """
    light = light or Light()
    lens = _lens(camera)
    gain = 10 ** (light.gain_db / 20)
    scale = WHITE_LEVEL * light.illumination * gain * light.exposure_us / FULL_SCALE_US
    picture = _reflectance(lens, camera_from_board, board_print(board))
    if light.blur_px > 0:
        cv2.GaussianBlur(picture, (0, 0), light.blur_px, picture, borderType=cv2.BORDER_REPLICATE)
    picture *= lens.vignetting
    picture *= np.float32(scale)
    picture += np.float32(BLACK_LEVEL + 0.5)
    if rng is not None and light.pixel_noise > 0:
        noise = rng.standard_normal(picture.shape, dtype=np.float32)
        noise *= np.float32(light.pixel_noise * gain)
        picture += noise
    np.clip(picture, 0.0, 255.0, out=picture)
    return picture.astype(np.uint8)


def scaled(camera: CameraModel, factor: float) -> CameraModel:
    """Scale a lens to `factor` times the pixels; pixel (0, 0) stays the centre of the first pixel."""
    if camera.matrix is None:
        raise ValueError("the camera has no matrix")
    (fx, skew, cx), (_, fy, cy), _ = camera.matrix
    matrix = (
        (fx * factor, skew * factor, (cx + 0.5) * factor - 0.5),
        (0.0, fy * factor, (cy + 0.5) * factor - 0.5),
        (0.0, 0.0, 1.0),
    )
    width, height = round(camera.width * factor), round(camera.height * factor)
    return msgspec.structs.replace(camera, width=width, height=height, matrix=matrix)


@lru_cache(maxsize=4)
def _lens(camera: CameraModel) -> _LensTable:
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    K = camera_matrix(camera)
    rays = (undistort(camera, np.stack([u, v], axis=-1).reshape(-1, 2)) - K[:2, 2]) / np.diag(K)[:2]
    x, y = np.asarray(rays.T.reshape(2, camera.height, camera.width), np.float32)
    corner = np.hypot(camera.width / 2, camera.height / 2)
    radius = np.hypot(u - camera.width / 2, v - camera.height / 2) / corner
    vignetting = 1.0 - VIGNETTING * radius**2
    return _LensTable(x, y, np.gradient(x), np.gradient(y), vignetting.astype(np.float32))


def _reflectance(lens: _LensTable, camera_from_board: Array, printed: BoardPrint) -> Floats:
    """Compute the mean albedo over each pixel."""
    if camera_from_board[:3, 2] @ camera_from_board[:3, 3] <= 0:  # seen from behind: z points away
        return np.full(lens.x.shape, TABLE_ALBEDO, dtype=np.float32)
    plane_from_ray = np.asarray(np.linalg.inv(camera_from_board[:3, [0, 1, 3]]), dtype=float)
    value = _sample(plane_from_ray, lens.x, lens.y, printed)
    kernel = np.ones((3, 3), dtype=np.uint8)
    edge = cv2.dilate(value, kernel) != cv2.erode(value, kernel)
    k = np.arange(_SAMPLES)[:, None]
    du, dv = (((n + 0.5) / _SAMPLES - 0.5).astype(np.float32) for n in (k, _STRIDE * k % _SAMPLES))
    x_fine, y_fine = (
        ray[edge] + du * right[edge] + dv * down[edge]
        for ray, (down, right) in ((lens.x, lens.x_slopes), (lens.y, lens.y_slopes))
    )
    value[edge] = _sample(plane_from_ray, x_fine, y_fine, printed).mean(axis=0)
    return value


def _sample(plane_from_ray: Array, x: Floats, y: Floats, printed: BoardPrint) -> Floats:
    """Compute the albedo where rays (x, y, 1) meet the board's plane; the table's where they miss it."""
    h = plane_from_ray.astype(np.float32)
    inverse_depth = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    ahead = inverse_depth > 1e-3
    safe = np.where(ahead, inverse_depth, np.float32(1.0))
    board_x = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / safe
    board_y = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / safe
    value = printed.albedo(board_x, board_y, TABLE_ALBEDO)
    return np.where(ahead, value, np.float32(TABLE_ALBEDO))
