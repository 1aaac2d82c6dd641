"""Print of a board: albedo as a function of position.

Origin and axes are those of the board's points: x to the right, y down, z into the board. Markers are laid
out by OpenCV's own board classes, as its detectors expect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.model import APRIL_DICTIONARY, dictionary_id
from recordings.schema.messages import SINGLE_TAGS, BoardKind, BoardSpec

Floats = NDArray[np.float32]
Ink = Callable[[Floats, Floats], NDArray[np.bool_]]
"""Function of positions x, y (arrays of one shape), metres → mask of black ones."""
Markers = Sequence[tuple[float, float, float, NDArray[np.bool_]]]
"""x, y of the corner and side, metres; black cells (n, n), border included"""

BLACK, WHITE = 0.05, 0.85
APRIL_GRID_BORDER_BITS = 1


@dataclass(frozen=True, eq=False)
class BoardPrint:
    """Piecewise constant print on a white sheet."""

    sheet_m: tuple[float, float, float, float]
    """x0, y0, x1, y1 of the white sheet"""
    black: Ink

    def albedo(self, x_m: Floats, y_m: Floats, around: float) -> Floats:
        """Compute the albedo at positions (arrays of one shape), metres; `around`: that beyond the sheet."""
        x0, y0, x1, y1 = self.sheet_m
        value = np.where(self.black(x_m, y_m), np.float32(BLACK), np.float32(WHITE))
        on_sheet = (x_m >= x0) & (x_m <= x1) & (y_m >= y0) & (y_m <= y1)
        return np.where(on_sheet, value, np.float32(around))


def _squares(columns: int, rows: int, square_m: float, first_white: bool = False) -> Ink:
    """Make a chequered pattern; the top left square is black and begins one square before the origin."""

    def black(x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        i = np.floor((x_m + np.float32(square_m)) * np.float32(1 / square_m))
        j = np.floor((y_m + np.float32(square_m)) * np.float32(1 / square_m))
        inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
        half = (i + j) * np.float32(0.5)
        even = half == np.floor(half)
        return np.asarray(inside & (even != first_white))

    return black


def _dots(centres_m: NDArray[np.float32], radius_m: float) -> Ink:
    """Make black dots around centres (n, 2), metres."""

    def black(x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        inked = np.zeros(x_m.shape, dtype=bool)
        for cx, cy in centres_m:
            inked |= (x_m - cx) ** 2 + (y_m - cy) ** 2 < np.float32(radius_m**2)
        return inked

    return black


def _markers(markers: Markers, beneath: Ink | None = None) -> Ink:
    """Make square markers on top of another pattern."""

    def black(x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        inked = np.zeros(x_m.shape, dtype=bool) if beneath is None else beneath(x_m, y_m)
        for x, y, side, cells in markers:
            inside = (x_m >= x) & (x_m < x + side) & (y_m >= y) & (y_m < y + side)
            per_m, last = len(cells) / side, len(cells) - 1
            column = ((x_m[inside] - np.float32(x)) * np.float32(per_m)).astype(int)
            row = ((y_m[inside] - np.float32(y)) * np.float32(per_m)).astype(int)
            inked[inside] = cells[np.clip(row, 0, last), np.clip(column, 0, last)]
        return inked

    return black


@lru_cache(maxsize=8)
def board_print(board: BoardSpec) -> BoardPrint:
    """Make the print of a board with a white margin of at least half a square."""
    columns, rows, s = board.columns, board.rows, board.square_m
    if board.kind is BoardKind.CHESSBOARD:
        sheet = (-1.5 * s, -1.5 * s, (columns + 0.5) * s, (rows + 0.5) * s)
        return BoardPrint(sheet, _squares(columns + 1, rows + 1, s))
    if board.kind in (BoardKind.CIRCLES, BoardKind.ASYMMETRIC_CIRCLES):
        centres = _circle_centres(board)
        right, bottom = centres.max(axis=0)
        sheet = (-1.5 * s, -1.5 * s, float(right) + 1.5 * s, float(bottom) + 1.5 * s)
        return BoardPrint(sheet, _dots(centres, 0.3 * s))
    if board.kind is BoardKind.CHARUCO:
        squares = _squares(columns, rows, s, first_white=board.legacy and rows % 2 == 0)
        sheet = (-1.5 * s, -1.5 * s, (columns - 0.5) * s, (rows - 0.5) * s)
        return BoardPrint(sheet, _markers(_charuco_markers(board), squares))
    if board.kind in SINGLE_TAGS:
        return _single_tag(board)
    return _april_grid(board)


def _circle_centres(board: BoardSpec) -> NDArray[np.float32]:
    i, j = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    if board.kind is BoardKind.ASYMMETRIC_CIRCLES:
        i = 2 * i + j % 2
    return (np.stack([i, j], axis=-1).reshape(-1, 2) * board.square_m).astype(np.float32)


def _dictionary(board: BoardSpec, default: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(dictionary_id(board.dictionary or default))


def _marker(
    dictionary: cv2.aruco.Dictionary, number: int, border: int, corners_m: NDArray[np.float32]
) -> tuple[float, float, float, NDArray[np.bool_]]:
    cells = dictionary.markerSize + 2 * border
    picture = cv2.aruco.generateImageMarker(dictionary, number, cells, borderBits=border)
    (x0, y0), (x1, _) = corners_m.min(axis=0)[:2], corners_m.max(axis=0)[:2]
    return float(x0), float(y0), float(x1 - x0), np.asarray(picture < 128)


def _charuco_markers(board: BoardSpec) -> Markers:
    """Place ChArUco markers; OpenCV's origin is the outer corner, the board's the first inner corner."""
    dictionary = _dictionary(board, "DICT_4X4_250")
    marker_m = board.marker_m or 0.75 * board.square_m
    layout = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, marker_m, dictionary)
    layout.setLegacyPattern(board.legacy)
    numbered = zip(np.asarray(layout.getIds()).ravel(), layout.getObjPoints(), strict=True)
    shift = np.float32(board.square_m)
    return [_marker(dictionary, int(n), 1, np.asarray(c, dtype=np.float32) - shift) for n, c in numbered]


def _single_tag(board: BoardSpec) -> BoardPrint:
    dictionary, side = _dictionary(board, APRIL_DICTIONARY), board.square_m
    corners = np.array([[0.0, 0.0], [side, side]], dtype=np.float32)
    tag = _marker(dictionary, board.tag_id, 1, corners)
    return BoardPrint((-side / 4, -side / 4, 1.25 * side, 1.25 * side), _markers([tag]))


def _april_grid(board: BoardSpec) -> BoardPrint:
    """Make tags of side `square_m`, `marker_m` apart, numbered as by Kalibr: by rows from the bottom left.

    As on Kalibr's print, small black squares are where the gaps cross.
    """
    side, gap = board.square_m, board.marker_m or 0.3 * board.square_m
    dictionary = _dictionary(board, APRIL_DICTIONARY)
    pitch = side + gap
    tags = []
    for number in range(board.columns * board.rows):
        row, column = divmod(number, board.columns)
        low = np.array([column * pitch, -row * pitch - side])
        corners = np.array([low, low + side], dtype=np.float32)
        tags.append(_marker(dictionary, number, APRIL_GRID_BORDER_BITS, corners))
    full = np.ones((1, 1), dtype=bool)
    places = product(range(board.columns + 1), range(board.rows + 1))
    crossings = [(column * pitch - gap, -row * pitch, gap, full) for column, row in places]
    width, height = board.columns * pitch, board.rows * pitch
    return BoardPrint((-2 * gap, -height - gap, width + gap, 2 * gap), _markers([*tags, *crossings]))
