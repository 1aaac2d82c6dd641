"""Boards to print at true scale, with a ruler to measure and their own parameters on them."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import msgspec
import numpy as np
import yaml
from numpy.typing import NDArray

from calibrate.boards.markers import charuco_board
from calibrate.boards.model import (
    BoardError,
    board_points,
    check_board,
    describe_board,
    dictionary_id,
    tag_dictionary,
)
from recordings.geometry import Array
from recordings.schema.messages import SINGLE_TAGS, BoardKind, BoardSpec

_MARGIN_MM = 7.0
_FOOT_MM = 16.0
_TEXT_MM = 2.6
_CIRCLE_SHARE = 0.25
"""Radius of a printed circle over the distance of neighbours."""
PAPER_MM = {
    "A4": (297.0, 210.0),
    "A3": (420.0, 297.0),
    "A2": (594.0, 420.0),
    "A1": (841.0, 594.0),
    "A0": (1189.0, 841.0),
}


@dataclass(frozen=True, eq=False)
class Sheet:
    """Black shapes and text on white paper, millimetres from the top left."""

    width_mm: float
    height_mm: float
    rectangles: Array
    """(n, 4) x, y, width, height"""
    circles: Array
    """(m, 3) x, y, radius"""
    texts: tuple[tuple[float, float, str], ...] = ()
    """x and y of the start of each line."""

    def encode(self, file_format: Literal["pdf", "svg"]) -> bytes:
        """Draw one page of the sheet's true size; the same sheet gives the same bytes."""
        import matplotlib  # a third of a second, for this command only
        from matplotlib.figure import Figure
        from matplotlib.patches import PathPatch
        from matplotlib.path import Path

        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
        shapes = [Path(at[:2] + corners * at[2:], closed=True) for at in self.rectangles]
        shapes += [Path.circle((x, y), radius) for x, y, radius in self.circles]
        ink = Path.make_compound_path(*shapes)  # one shape: no hairlines between neighbours
        figure = Figure(figsize=(self.width_mm / 25.4, self.height_mm / 25.4))
        axes = figure.add_axes((0, 0, 1, 1), xlim=(0, self.width_mm), ylim=(self.height_mm, 0))
        axes.set_axis_off()
        axes.add_patch(PathPatch(ink, facecolor="black", edgecolor="none"))
        for x, y, text in self.texts:
            axes.text(x, y, text, fontsize=_TEXT_MM * 72 / 25.4)
        content, date = io.BytesIO(), "CreationDate" if file_format == "pdf" else "Date"
        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "board"}):
            figure.savefig(content, format=file_format, metadata={date: None})
        return content.getvalue()

    def pixels(self, px_mm: float) -> NDArray[np.uint8]:
        """Draw the shapes without text, black 0 on white 255, (height, width); edges fall between pixels."""
        image = np.full((round(self.height_mm * px_mm), round(self.width_mm * px_mm)), 255, np.uint8)
        edges = np.round(np.cumsum(self.rectangles.reshape(-1, 2, 2), axis=1) * px_mm).astype(int)
        for (left, top), (right, bottom) in edges:
            image[top:bottom, left:right] = 0
        sixteenths = np.round(16 * (self.circles * px_mm - [0.5, 0.5, 0])).astype(int)
        for x, y, radius in sixteenths.tolist():
            cv2.circle(image, (x, y), radius, 0, cv2.FILLED, cv2.LINE_AA, shift=4)
        return image


def board_texture(spec: BoardSpec, square_px: int) -> NDArray[np.uint8]:
    """Draw the board as the texture of a simulated one: `square_px` pixels a square, white border of one.

    Raises BoardError for an impossible board.
    """
    check_board(spec)
    squares, circles, width, height = draw_pattern(spec)
    side = spec.square_m * 1000
    shapes = _moved(squares, side, side), _moved(circles, side, side)
    return Sheet(width + 2 * side, height + 2 * side, *shapes).pixels(square_px / side)


def board_sheet(spec: BoardSpec, paper: str | None = None) -> Sheet:
    """Lay out the board with ruler and text, centred on `paper` (A4 … A0) or on a sheet as large as needed.

    Raises BoardError for an impossible board and for a sheet that is too small.
    """
    check_board(spec)
    squares, circles, width, height = draw_pattern(spec)
    need_w, need_h = width + 2 * _MARGIN_MM, height + 2 * _MARGIN_MM + _FOOT_MM
    sheet_w, sheet_h = (need_w, need_h) if paper is None else _paper(paper, need_w, need_h, spec)
    x, y = (sheet_w - width) / 2, (sheet_h - _FOOT_MM - height) / 2
    ruler_y = y + height + _MARGIN_MM
    length = int(min(max(width, 60.0), 150.0) // 10) * 10
    says = f"{describe_board(spec)}. The bar is {length} mm: measure it, and one square, before use."
    marks, letters = _origin(spec, x, y, height)
    return Sheet(
        sheet_w,
        sheet_h,
        np.concatenate([_moved(squares, x, y), _moved(_ruler(length), x, ruler_y), marks]),
        _moved(circles, x, y),
        ((x, ruler_y + 5.0, says), (x, ruler_y + 9.5, _yaml(spec)), *letters),
    )


def _origin(
    spec: BoardSpec, x: float, y: float, height: float
) -> tuple[Array, tuple[tuple[float, float, str], ...]]:
    """Marks in the margins where the lines through the board's origin leave the pattern, with their axes.

    A single tag has none: its origin is the top left of the black square.
    """
    if spec.kind in SINGLE_TAGS:
        return np.zeros((0, 4)), ()
    right, down = origin_mm(spec, height)
    ticks = np.array([[x + right - 0.15, y - 4.5, 0.3, 3.0], [x - 4.5, y + down - 0.15, 3.0, 0.3]])
    return ticks, ((x + right + 1.0, y - 2.0, "x → from the origin"), (x - 5.0, y + down + 3.5, "y ↓"))


def origin_mm(spec: BoardSpec, height: float) -> tuple[float, float]:
    """Return x and y of the board's origin in its pattern, which is `height` mm tall."""
    side, gap = spec.square_m * 1000, (spec.marker_m or 0.0) * 1000
    if spec.kind in SINGLE_TAGS:
        return (height - side) / 2, (height - side) / 2
    return (gap, height - gap) if spec.kind is BoardKind.APRIL_GRID else (side, side)


def _paper(paper: str, need_w: float, need_h: float, spec: BoardSpec) -> tuple[float, float]:
    if paper not in PAPER_MM:
        raise BoardError("paper-unknown", paper=paper, papers=", ".join(PAPER_MM))
    short, long = sorted(PAPER_MM[paper])
    fits = [size for size in ((long, short), (short, long)) if need_w <= size[0] and need_h <= size[1]]
    if not fits:
        board = describe_board(spec)
        raise BoardError("paper-too-small", board=board, paper=paper, width_mm=need_w, height_mm=need_h)
    return fits[0]


_Drawn = tuple[Array, Array, float, float]
"""Black rectangles (n, 4), circles (m, 3), width and height of the pattern, mm."""
_NO_CIRCLES = np.zeros((0, 3))


def draw_pattern(spec: BoardSpec) -> _Drawn:
    """Draw what is black, from the top left of the pattern on; no margins."""
    return _DRAWN[spec.kind](spec)


def _chessboard(spec: BoardSpec) -> _Drawn:
    """The square before the first inner corner is black."""
    side, shape = spec.square_m * 1000, (spec.rows + 1, spec.columns + 1)
    squares = _cells(np.indices(shape).sum(axis=0) % 2 == 0, side)
    return squares, _NO_CIRCLES, shape[1] * side, shape[0] * side


def _circles(spec: BoardSpec) -> _Drawn:
    pitch = spec.square_m * 1000
    radius = pitch * _CIRCLE_SHARE * (1.4 if spec.kind is BoardKind.ASYMMETRIC_CIRCLES else 1.0)
    circles = board_points(spec) * 1000 + [pitch, pitch, radius]
    width, height = circles[:, :2].max(axis=0) + pitch
    return np.zeros((0, 4)), circles, float(width), float(height)


def _charuco(spec: BoardSpec) -> _Drawn:
    side, marker = spec.square_m * 1000, (spec.marker_m or 0.0) * 1000
    board = charuco_board(spec)
    corners = np.array(board.getObjPoints(), dtype=float)[..., :2].min(axis=1) * 1000
    black = np.ones((spec.rows, spec.columns), dtype=bool)
    black[tuple((corners // side).astype(int).T[::-1])] = False
    markers = [
        _marker(spec.dictionary or "", number, x, y, marker, 1)
        for number, (x, y) in zip(board.getIds().ravel().tolist(), corners.tolist(), strict=True)
    ]
    return (
        np.concatenate([_cells(black, side), *markers]),
        _NO_CIRCLES,
        spec.columns * side,
        spec.rows * side,
    )


def _april_grid(spec: BoardSpec) -> _Drawn:
    """Draw it like Kalibr: tag 0 at the bottom left, two bits of border, black squares between."""
    side, gap = spec.square_m * 1000, (spec.marker_m or 0.0) * 1000
    pitch = side + gap
    width, height = spec.columns * pitch + gap, spec.rows * pitch + gap
    row, column = np.indices((spec.rows + 1, spec.columns + 1)).reshape(2, -1) * pitch
    between = np.stack([column, row, np.full(row.shape, gap), np.full(row.shape, gap)], axis=1)
    tags = []
    for number in range(spec.columns * spec.rows):
        r, c = divmod(number, spec.columns)
        top = height - gap - r * pitch - side
        tags.append(_marker(tag_dictionary(spec), number, gap + c * pitch, top, side, 2))
    return np.concatenate([between, *tags]), _NO_CIRCLES, width, height


def _tag(spec: BoardSpec) -> _Drawn:
    """One tag with a quiet zone of one cell."""
    side, dictionary = spec.square_m * 1000, tag_dictionary(spec)
    quiet = side / (cv2.aruco.getPredefinedDictionary(dictionary_id(dictionary)).markerSize + 2)
    whole = side + 2 * quiet
    return _marker(dictionary, spec.tag_id, quiet, quiet, side, 1), _NO_CIRCLES, whole, whole


_DRAWN: dict[BoardKind, Callable[[BoardSpec], _Drawn]] = {
    BoardKind.CHESSBOARD: _chessboard,
    BoardKind.CIRCLES: _circles,
    BoardKind.ASYMMETRIC_CIRCLES: _circles,
    BoardKind.CHARUCO: _charuco,
    BoardKind.APRIL_GRID: _april_grid,
    BoardKind.ARUCO: _tag,
    BoardKind.APRIL_TAG: _tag,
}


def _marker(dictionary: str, number: int, x: float, y: float, side: float, border_bits: int) -> Array:
    family = cv2.aruco.getPredefinedDictionary(dictionary_id(dictionary))
    cells = family.markerSize + 2 * border_bits
    bits = np.asarray(cv2.aruco.generateImageMarker(family, number, cells, borderBits=border_bits))
    return _moved(_cells(bits == 0, side / cells), x, y)


def _moved(shapes: Array, x: float, y: float) -> Array:
    return np.concatenate([shapes[:, :2] + (x, y), shapes[:, 2:]], axis=1)


def _cells(black: NDArray[np.bool_], side: float) -> Array:
    """Rectangles (n, 4) of the black cells of a grid, runs of a row joined."""
    edges = np.diff(np.pad(black, ((0, 0), (1, 1))).astype(int), axis=1)
    row, first = np.nonzero(edges == 1)
    _, end = np.nonzero(edges == -1)
    return np.stack([first, row, end - first, np.ones(len(row))], axis=1) * side


def _ruler(length_mm: int) -> Array:
    """Rectangles (n, 4): a bar with marks 10 mm apart, every fifth one taller."""
    tall = [(10.0 * k - 0.1, 4.0 if k % 5 == 0 else 2.5) for k in range(length_mm // 10 + 1)]
    return np.array([[0.0, 0.0, length_mm, 0.3], *([x, -height, 0.2, height] for x, height in tall)])


def _yaml(spec: BoardSpec) -> str:
    """Describe the board as a configuration does, in one line."""
    fields: str = yaml.safe_dump(
        msgspec.to_builtins(spec), default_flow_style=True, sort_keys=False, width=999
    )
    return f"board: {fields.strip()}"
