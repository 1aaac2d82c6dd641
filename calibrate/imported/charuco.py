"""Whether a chessboard is the inside of a ChArUco board: markers in its squares tell, and which they are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from calibrate.boards.corners import Grey, through
from calibrate.boards.markers import marker_detector
from calibrate.boards.model import board_points
from recordings.geometry import Array
from recordings.schema.messages import BoardKind, BoardSpec

DICTIONARIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_36H11")
"""Ends of the names of OpenCV's dictionaries, each the largest of its kind."""
_SMALLER = (50, 100, 250, 1000)
"""Markers of the dictionaries of one kind: each begins with the markers of the smaller ones."""
_SQUARE_PX = 60.0
"""Images are enlarged until a square has so many pixels: else small markers are not seen."""
_LARGEST_FACTOR = 3.0
"""They are enlarged at most so many times."""
_OFF_CENTRE = 0.2
"""A marker's middle lies nearer to that of its square, in squares."""
_SHARES = 0.3, 0.95
"""Sides of markers that a square can hold, in squares."""
_MOST_BEYOND = 2
"""Columns or rows of a board that the chessboard detector leaves out at its sides."""
_FEWEST_IN_AN_IMAGE = 2
"""Markers of which one alone may be misread."""


@dataclass(frozen=True)
class MarkersInSquares:
    """Markers that lie in the squares of a supposed chessboard."""

    dictionary: str
    """The smallest one that holds them."""
    share: float
    """Side of a marker over that of a square."""


def markers_in_squares(board: BoardSpec, seen: Iterable[tuple[Grey, Array]]) -> MarkersInSquares | None:
    """Look for markers in the squares of a chessboard; `seen`: images, and all its corners (k, 2) px in each.

    None: in no image there are two of one dictionary.
    """
    points = board_points(board)[:, :2] / board.square_m
    numbers: dict[str, set[int]] = {}
    shares: dict[str, list[float]] = {}
    for grey, pixels in seen:
        grid = pixels.reshape(board.rows, board.columns, 2)
        square_px = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=2)))
        factor = float(np.clip(_SQUARE_PX / square_px, 1.0, _LARGEST_FACTOR))
        large = np.asarray(cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC))
        H, _ = cv2.findHomography((pixels + 0.5) * factor - 0.5, points, 0)
        for end in DICTIONARIES:
            markers, ids, _ = marker_detector(f"DICT_{end}", 1).detectMarkers(large)
            inside = {} if ids is None else _inside(board, np.asarray(H), markers, ids.ravel().tolist())
            if len(inside) >= _FEWEST_IN_AN_IMAGE:
                numbers.setdefault(end, set()).update(inside)
                shares.setdefault(end, []).extend(inside.values())
    if not numbers:
        return None
    end = max(numbers, key=lambda each: len(shares[each]))
    return MarkersInSquares(_smallest(end, max(numbers[end])), float(np.median(shares[end])))


def _inside(board: BoardSpec, H: Array, markers: Iterable[Array], ids: list[int]) -> dict[int, float]:
    """Number → side, in squares, of the markers in the middle of a square; `H`: pixels to squares."""
    found: dict[int, float] = {}
    for number, marker in zip(ids, markers, strict=True):
        corners = through(H, np.asarray(marker, float).reshape(4, 2))
        middle = corners.mean(axis=0)
        side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
        on_board = (middle > -1).all() and middle[0] < board.columns and middle[1] < board.rows
        is_central = np.abs(middle % 1 - 0.5).max() < _OFF_CENTRE
        if on_board and is_central and _SHARES[0] < side < _SHARES[1]:
            found[number] = side
    return found


def _smallest(end: str, largest_number: int) -> str:
    kind, _, count = end.rpartition("_")
    if not count.isdigit():
        return f"DICT_{end}"
    return f"DICT_{kind}_{next(each for each in _SMALLER if largest_number < each)}"


def layouts(board: BoardSpec, markers: MarkersInSquares) -> Iterator[BoardSpec]:
    """The ChArUco boards whose inside, or a part of it, a chessboard is, the smallest first.

    Which side is the columns' and how far the board goes on only the markers' numbers tell.
    """
    sides = {
        (columns + more_columns, rows + more_rows)
        for columns, rows in ((board.columns + 1, board.rows + 1), (board.rows + 1, board.columns + 1))
        for more_columns in range(_MOST_BEYOND + 1)
        for more_rows in range(_MOST_BEYOND + 1)
    }
    marker_m = markers.share * board.square_m
    for columns, rows in sorted(sides, key=lambda each: each[0] * each[1]):
        for legacy in (False, True):
            yield BoardSpec(
                BoardKind.CHARUCO, columns, rows, board.square_m, marker_m, markers.dictionary, legacy
            )
