"""Print of a board, as `calibrate board` draws it: albedo as a function of position.

Origin and axes are those of the board's points: x to the right, y down, z into the board.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calibrate.boards.printing import draw_pattern, origin_mm
from recordings.schema.messages import BoardSpec

Floats = NDArray[np.float32]
BLACK, WHITE = 0.05, 0.85


@dataclass(frozen=True, eq=False)
class BoardPrint:
    """Piecewise constant print on a white sheet. Positions are metres, arrays of one shape."""

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
