"""Boards to print at true scale, with a ruler to measure and their own parameters on them."""

from __future__ import annotations

import cv2
import numpy as np

from calibrate.boards.markers import charuco_board
from calibrate.boards.model import BoardError, check_board, describe_board, dictionary_id, tag_dictionary
from calibrate.boards.vector import Circle, Line, Rectangle, Shape, Sheet, moved
from recordings.schema.messages import SINGLE_TAGS, BoardKind, BoardSpec

_MARGIN_MM = 7.0
_FOOT_MM = 16.0
_CIRCLE_SHARE = 0.25
"""Radius of a printed circle over the distance of neighbours."""
PAPER_MM = {
    "A4": (297.0, 210.0),
    "A3": (420.0, 297.0),
    "A2": (594.0, 420.0),
    "A1": (841.0, 594.0),
    "A0": (1189.0, 841.0),
}


def board_sheet(spec: BoardSpec, paper: str | None = None) -> Sheet:
    """The board with ruler and text. `paper` (A4 … A0): centred on that sheet; BoardError when too small.

    Without `paper` the sheet is as large as the board needs.
    """
    check_board(spec)
    shapes, width, height = _BOARDS[spec.kind](spec)
    need_w, need_h = width + 2 * _MARGIN_MM, height + 2 * _MARGIN_MM + _FOOT_MM
    sheet_w, sheet_h = need_w, need_h
    if paper is not None:
        sheet_w, sheet_h = _paper(paper, need_w, need_h, spec)
    x, y = (sheet_w - width) / 2, (sheet_h - _FOOT_MM - height) / 2
    drawn = [moved(shape, x, y) for shape in shapes]
    foot = _foot(spec, x, y + height + _MARGIN_MM, max(width, 60.0))
    return Sheet(sheet_w, sheet_h, (*drawn, *foot))


def _paper(paper: str, need_w: float, need_h: float, spec: BoardSpec) -> tuple[float, float]:
    if paper not in PAPER_MM:
        raise BoardError(f"there is no paper {paper!r}; there are: {', '.join(PAPER_MM)}.")
    for width, height in (PAPER_MM[paper], PAPER_MM[paper][::-1]):
        if need_w <= width and need_h <= height:
            return width, height
    fitting = [
        name
        for name, (w, h) in PAPER_MM.items()
        if (need_w <= w and need_h <= h) or (need_w <= h and need_h <= w)
    ]
    hint = f"it fits on {fitting[0]}" if fitting else "make the squares smaller"
    raise BoardError(f"{describe_board(spec)} needs {need_w:.0f} × {need_h:.0f} mm: not on {paper}; {hint}.")


def _chessboard(spec: BoardSpec) -> tuple[list[Shape], float, float]:
    """The square before the first inner corner is black."""
    side = spec.square_m * 1000
    squares: list[Shape] = [
        Rectangle(c * side, r * side, side, side)
        for r in range(spec.rows + 1)
        for c in range(spec.columns + 1)
        if (r + c) % 2 == 0
    ]
    return squares, (spec.columns + 1) * side, (spec.rows + 1) * side


def _circles(spec: BoardSpec) -> tuple[list[Shape], float, float]:
    pitch = spec.square_m * 1000
    asymmetric = spec.kind is BoardKind.ASYMMETRIC_CIRCLES
    across = 2 * spec.columns - 1 if asymmetric else spec.columns - 1
    radius = pitch * _CIRCLE_SHARE * (1.4 if asymmetric else 1.0)
    circles: list[Shape] = [
        Circle(pitch * ((2 * c + r % 2 if asymmetric else c) + 1), pitch * (r + 1), radius)
        for r in range(spec.rows)
        for c in range(spec.columns)
    ]
    return circles, pitch * (across + 2), pitch * (spec.rows + 1)


def _charuco(spec: BoardSpec) -> tuple[list[Shape], float, float]:
    side, marker = spec.square_m * 1000, (spec.marker_m or 0.0) * 1000
    board = charuco_board(spec)
    taken = {
        (round(float(c[:, 1].mean()) * 1000 / side - 0.5), round(float(c[:, 0].mean()) * 1000 / side - 0.5))
        for c in board.getObjPoints()
    }
    shapes: list[Shape] = [
        Rectangle(c * side, r * side, side, side)
        for r in range(spec.rows)
        for c in range(spec.columns)
        if (r, c) not in taken
    ]
    for corners, number in zip(board.getObjPoints(), board.getIds().ravel().tolist(), strict=True):
        x, y = (float(v) * 1000 for v in corners[:, :2].min(axis=0))
        shapes += _marker(spec.dictionary or "", int(number), x, y, marker, 1)
    return shapes, spec.columns * side, spec.rows * side


def _april_grid(spec: BoardSpec) -> tuple[list[Shape], float, float]:
    """As Kalibr draws it: tag 0 at the bottom left, two bits of border, black squares between."""
    side, gap = spec.square_m * 1000, (spec.marker_m or 0.0) * 1000
    pitch = side + gap
    width, height = spec.columns * pitch + gap, spec.rows * pitch + gap
    shapes: list[Shape] = [
        Rectangle(c * pitch, r * pitch, gap, gap)
        for r in range(spec.rows + 1)
        for c in range(spec.columns + 1)
    ]
    for number in range(spec.columns * spec.rows):
        r, c = divmod(number, spec.columns)
        top = height - gap - r * pitch - side
        shapes += _marker(tag_dictionary(spec), number, gap + c * pitch, top, side, 2)
    return shapes, width, height


def _tag(spec: BoardSpec) -> tuple[list[Shape], float, float]:
    """One tag with a quiet zone of one cell."""
    side, dictionary = spec.square_m * 1000, tag_dictionary(spec)
    family = cv2.aruco.getPredefinedDictionary(dictionary_id(dictionary))
    quiet = side / (family.markerSize + 2)
    return _marker(dictionary, spec.tag_id, quiet, quiet, side, 1), side + 2 * quiet, side + 2 * quiet


_BOARDS = {
    BoardKind.CHESSBOARD: _chessboard,
    BoardKind.CIRCLES: _circles,
    BoardKind.ASYMMETRIC_CIRCLES: _circles,
    BoardKind.CHARUCO: _charuco,
    BoardKind.APRIL_GRID: _april_grid,
    BoardKind.ARUCO: _tag,
    BoardKind.APRIL_TAG: _tag,
}


def _marker(dictionary: str, number: int, x: float, y: float, side: float, border_bits: int) -> list[Shape]:
    """Black cells of one marker, runs of a row joined."""
    family = cv2.aruco.getPredefinedDictionary(dictionary_id(dictionary))
    cells = family.markerSize + 2 * border_bits
    bits = np.asarray(cv2.aruco.generateImageMarker(family, number, cells, borderBits=border_bits))
    step = side / cells
    found: list[Shape] = []
    for r in range(cells):
        c = 0
        while c < cells:
            end = c
            while end < cells and bits[r, end] == 0:
                end += 1
            if end > c:
                found.append(Rectangle(x + c * step, y + r * step, (end - c) * step, step))
            c = max(end, c + 1)
    return found


def _foot(spec: BoardSpec, x: float, y: float, width: float) -> list[Shape]:
    """A ruler whose marks are 10 mm apart, and what the board is."""
    length = int(min(max(width, 50.0), 150.0) // 10) * 10
    marks: list[Shape] = [Rectangle(x, y, length, 0.3)]
    for k in range(length // 10 + 1):
        tall = 4.0 if k % 5 == 0 else 2.5
        marks.append(Rectangle(x + 10 * k - 0.1, y - tall, 0.2, tall))
    says = f"{describe_board(spec)}. The bar is {length} mm: measure it, and one square, before use."
    return [*marks, Line(x, y + 5.0, 3.0, says), Line(x, y + 9.5, 3.0, _yaml(spec))]


def _yaml(spec: BoardSpec) -> str:
    fields = [f"kind: {spec.kind.value}"]
    if spec.kind in SINGLE_TAGS:
        fields.append(f"id: {spec.tag_id}")
    else:
        fields += [f"columns: {spec.columns}", f"rows: {spec.rows}"]
    fields.append(f"square_m: {spec.square_m:g}")
    if spec.marker_m is not None:
        fields.append(f"marker_m: {spec.marker_m:g}")
    if spec.dictionary:
        fields.append(f"dictionary: {spec.dictionary}")
    if spec.legacy:
        fields.append("legacy: true")
    return "board: {" + ", ".join(fields) + "}"
