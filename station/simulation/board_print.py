"""The print on a board: albedo as a function of the place on it.

The place (0, 0) and the directions are those of the board's points: x to the right, y down, z into the
board. Markers are laid out by OpenCV's own board classes, so that its detectors see what they expect.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.model import APRIL_DICTIONARY, dictionary_id
from recordings.schema.messages import SINGLE_TAGS, BoardKind, BoardSpec

Floats = NDArray[np.float32]

BLACK, WHITE = 0.05, 0.85
APRIL_GRID_BORDER_BITS = 1


@dataclass(frozen=True, eq=False)
class BoardPrint:
    """A piecewise constant print on a white sheet."""

    sheet_m: tuple[float, float, float, float]
    """x0, y0, x1, y1 of the white sheet"""
    ink: _Ink

    def albedo(self, x_m: Floats, y_m: Floats, around: float) -> Floats:
        """Reflectance at places (any equal shapes); `around` beyond the sheet."""
        x0, y0, x1, y1 = self.sheet_m
        value = np.where(self.ink.black(x_m, y_m), np.float32(BLACK), np.float32(WHITE))
        on_sheet = (x_m >= x0) & (x_m <= x1) & (y_m >= y0) & (y_m <= y1)
        return np.where(on_sheet, value, np.float32(around))


class _Ink:
    """Print of a board, by where it is black."""

    def black(self, x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        raise NotImplementedError


@dataclass(frozen=True)
class _Squares(_Ink):
    """Chequered squares; the first (top left) one is black, unless `first_white`."""

    columns: int
    rows: int
    square_m: float
    origin_m: float
    """Both coordinates of the outer corner of the first square."""
    first_white: bool = False

    def black(self, x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        i = np.floor((x_m - np.float32(self.origin_m)) * np.float32(1 / self.square_m))
        j = np.floor((y_m - np.float32(self.origin_m)) * np.float32(1 / self.square_m))
        inside = (i >= 0) & (i < self.columns) & (j >= 0) & (j < self.rows)
        half = (i + j) * np.float32(0.5)
        even = half == np.floor(half)
        return np.asarray(inside & (even != self.first_white))


@dataclass(frozen=True, eq=False)
class _Dots(_Ink):
    centres_m: NDArray[np.float32]
    """(n, 2)"""
    radius_m: float

    def black(self, x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        inked = np.zeros(x_m.shape, dtype=bool)
        for cx, cy in self.centres_m:
            inked |= (x_m - cx) ** 2 + (y_m - cy) ** 2 < np.float32(self.radius_m**2)
        return inked


@dataclass(frozen=True, eq=False)
class _Marker:
    x_m: float
    y_m: float
    side_m: float
    black_cells: NDArray[np.bool_]
    """(n, n), border included"""


@dataclass(frozen=True, eq=False)
class _Markers(_Ink):
    """Square markers over what lies beneath."""

    beneath: _Ink
    markers: tuple[_Marker, ...]

    def black(self, x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        inked = self.beneath.black(x_m, y_m)
        for m in self.markers:
            inside = (x_m >= m.x_m) & (x_m < m.x_m + m.side_m) & (y_m >= m.y_m) & (y_m < m.y_m + m.side_m)
            cell = len(m.black_cells) / m.side_m
            column = ((x_m[inside] - np.float32(m.x_m)) * np.float32(cell)).astype(int)
            row = ((y_m[inside] - np.float32(m.y_m)) * np.float32(cell)).astype(int)
            last = len(m.black_cells) - 1
            inked[inside] = m.black_cells[np.clip(row, 0, last), np.clip(column, 0, last)]
        return inked


@lru_cache(maxsize=8)
def board_print(board: BoardSpec) -> BoardPrint:
    """The print of a board with a white margin of at least half a square around it."""
    columns, rows, s = board.columns, board.rows, board.square_m
    if board.kind is BoardKind.CHESSBOARD:
        ink: _Ink = _Squares(columns + 1, rows + 1, s, origin_m=-s)
        return BoardPrint((-1.5 * s, -1.5 * s, (columns + 0.5) * s, (rows + 0.5) * s), ink)
    if board.kind in (BoardKind.CIRCLES, BoardKind.ASYMMETRIC_CIRCLES):
        centres = _circle_centres(board)
        right, bottom = centres.max(axis=0)
        return BoardPrint(
            (-1.5 * s, -1.5 * s, float(right) + 1.5 * s, float(bottom) + 1.5 * s), _Dots(centres, 0.3 * s)
        )
    if board.kind is BoardKind.CHARUCO:
        first_white = board.legacy and rows % 2 == 0
        squares = _Squares(columns, rows, s, origin_m=-s, first_white=first_white)
        markers = _charuco_markers(board)
        sheet = (-1.5 * s, -1.5 * s, (columns - 0.5) * s, (rows - 0.5) * s)
        return BoardPrint(sheet, _Markers(squares, markers))
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
) -> _Marker:
    cells = dictionary.markerSize + 2 * border
    picture = cv2.aruco.generateImageMarker(dictionary, number, cells, borderBits=border)
    (x0, y0), (x1, _) = corners_m.min(axis=0)[:2], corners_m.max(axis=0)[:2]
    return _Marker(float(x0), float(y0), float(x1 - x0), np.asarray(picture < 128))


def _charuco_markers(board: BoardSpec) -> tuple[_Marker, ...]:
    """OpenCV counts from the outer corner of the first square, the board's frame from the first inner one."""
    dictionary = _dictionary(board, "DICT_4X4_250")
    marker_m = board.marker_m or 0.75 * board.square_m
    layout = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, marker_m, dictionary)
    layout.setLegacyPattern(board.legacy)
    return tuple(
        _marker(
            dictionary, int(number), 1, np.asarray(corners, dtype=np.float32) - np.float32(board.square_m)
        )
        for number, corners in zip(np.asarray(layout.getIds()).ravel(), layout.getObjPoints(), strict=True)
    )


def _single_tag(board: BoardSpec) -> BoardPrint:
    dictionary, side = _dictionary(board, APRIL_DICTIONARY), board.square_m
    corners = np.array([[0.0, 0.0], [side, side]], dtype=np.float32)
    tag = _marker(dictionary, board.tag_id, 1, corners)
    blank = _Dots(np.zeros((0, 2), np.float32), 0.0)
    return BoardPrint((-side / 4, -side / 4, 1.25 * side, 1.25 * side), _Markers(blank, (tag,)))


def _april_grid(board: BoardSpec) -> BoardPrint:
    """Tags of side `square_m`, `marker_m` apart, numbered as Kalibr does: row by row from the bottom left.

    Small black squares where the gaps cross, as on Kalibr's print.
    """
    side, gap = board.square_m, board.marker_m or 0.3 * board.square_m
    dictionary = _dictionary(board, APRIL_DICTIONARY)
    pitch = side + gap
    tags = []
    for number in range(board.columns * board.rows):
        row, column = divmod(number, board.columns)
        low = np.array([column * pitch, -row * pitch - side])
        tags.append(
            _marker(dictionary, number, APRIL_GRID_BORDER_BITS, np.array([low, low + side], dtype=np.float32))
        )
    full = np.ones((1, 1), dtype=bool)
    crossings = [
        _Marker(column * pitch - gap, -row * pitch, gap, full)
        for column in range(board.columns + 1)
        for row in range(board.rows + 1)
    ]
    width, height = board.columns * pitch, board.rows * pitch
    blank = _Dots(np.zeros((0, 2), np.float32), 0.0)
    return BoardPrint((-2 * gap, -height - gap, width + gap, 2 * gap), _Markers(blank, (*tags, *crossings)))
