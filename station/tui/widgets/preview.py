"""The camera's image and its found corners, drawn by half blocks."""

from __future__ import annotations

import base64
from functools import lru_cache
from itertools import groupby

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.segment import Segment
from rich.style import Style
from textual.geometry import Size
from textual.reactive import reactive
from textual.strip import Strip
from textual.widget import Widget

from station.protocol import verbs

LEVELS = 20
"""Shades a terminal image is drawn with: fewer styles to send, and no eye sees more in half blocks."""
_CORNER, _WANTED = -1, -2
"""Cells that show a corner, or the outline of the wanted view, in place of shades."""
_BLACK = Color.from_rgb(0, 0, 0)
SIGNS = {
    _CORNER: Segment("+", Style(color=Color.from_rgb(0, 230, 0), bgcolor=_BLACK, bold=True)),
    _WANTED: Segment("o", Style(color=Color.from_rgb(255, 200, 0), bgcolor=_BLACK, bold=True)),
}
"""Signs, and not only colours."""
OLD = "OLD IMAGE"
Outline = tuple[tuple[float, float], ...]
FEW_SHADES = " ░▒▓█"
"""Shades of a console with 16 colours, whose backgrounds have no greys: one a cell, dithered."""
_BAYER = (np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) + 0.5) / 16
"""Thresholds of ordered dithering. True greys are not dithered: each cell would need a style of its own."""


class PreviewPane(Widget):
    """The last image it was given; scales with its own size, keeps the aspect ratio."""

    DEFAULT_CSS = "PreviewPane { width: 1fr; height: 1fr; }"

    old: reactive[bool] = reactive(False)
    """The image is out of date; written across it."""
    wanted: reactive[Outline] = reactive(())
    """Corners of the board in the wanted view, in order, as shares of the image's sides; drawn as a line."""

    def __init__(self, *, id: str | None = None) -> None:
        super().__init__(id=id)
        self._image: NDArray[np.uint8] | None = None
        self._sequence: int | None = None
        self._corners: NDArray[np.float64] = np.zeros((0, 2))
        self._rows: list[Strip] = []
        self._rows_size = Size(0, 0)

    def show(self, answer: verbs.PreviewImage) -> None:
        """Show an image, if there is one and it does not stand there already."""
        if answer.sequence == self._sequence or not answer.jpeg_base64:
            return
        data = np.frombuffer(base64.b64decode(answer.jpeg_base64), dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        if image is None:
            return
        self._image, self._sequence = np.asarray(image, dtype=np.uint8), answer.sequence
        self._corners = np.array(answer.corners, dtype=float).reshape(-1, 2)
        self._rows_size = Size(0, 0)
        self.refresh()

    def watch_wanted(self) -> None:
        self._rows_size = Size(0, 0)

    def wanted_pixels(self) -> tuple[int, int]:
        """Return width and height of the largest image that this widget can show."""
        return max(16, self.size.width), max(16, 2 * self.size.height)

    def render_line(self, y: int) -> Strip:
        if self._rows_size != self.size:
            self._rows, self._rows_size = self._draw(self.size), self.size
        if self.old and self._image is not None and y == self.size.height // 2:
            return Strip([Segment(OLD.center(self.size.width), Style(reverse=True, bold=True))])
        return self._rows[y] if y < len(self._rows) else Strip.blank(self.size.width, self.rich_style)

    def _draw(self, size: Size) -> list[Strip]:
        if self._image is None or size.width < 2 or size.height < 1:
            words = Segment("no image yet".center(size.width), self.rich_style)
            return [Strip([words])] if size.width else []
        height, width = self._image.shape
        scale = min(size.width / width, 2 * size.height / height)
        columns, rows = max(1, int(width * scale)), max(2, int(height * scale) // 2 * 2)
        small = cv2.resize(self._image, (columns, rows), interpolation=cv2.INTER_AREA)
        shades = (small.astype(int) * LEVELS // 256).reshape(rows // 2, 2, columns)
        few = None
        if self.app.current_theme.ansi:
            # White on black, so that light is light on a white terminal too.
            few = Style() if self.app.no_color else Style(color="white", bgcolor="black")
        dark = np.tile(_BAYER, (rows // 8 + 1, columns // 4 + 1))[: rows // 2, :columns]
        dithered = small.reshape(shades.shape).mean(axis=1) / 255 * (len(FEW_SHADES) - 1) + dark
        cells = (shades[:, 0] * LEVELS + shades[:, 1] if few is None else dithered.astype(int)).tolist()
        lined = np.zeros((rows // 2, columns), np.uint8)
        if self.wanted:
            places = np.rint(np.array(self.wanted) * lined.shape[::-1]).astype(np.int32)
            cv2.polylines(lined, [places], True, 1)
        for row, column in np.argwhere(lined).tolist():
            cells[row][column] = _WANTED
        for x, y in self._corners:
            row, column = int(y * rows) // 2, int(x * columns)
            if 0 <= row < rows // 2 and 0 <= column < columns:
                cells[row][column] = _CORNER
        left = (size.width - columns) // 2
        sides = [Segment(" " * room, self.rich_style) for room in (left, size.width - columns - left)]
        return [Strip([sides[0], *_runs(line, few), sides[1]], size.width) for line in cells]


def _runs(line: list[int], few: Style | None) -> list[Segment]:
    """Join equal neighbours: less to send over ssh."""
    runs: list[Segment] = []
    for cell, alike in groupby(line):
        count = len(list(alike))
        if cell in SIGNS:
            runs += [SIGNS[cell]] * count
        elif few is not None:
            runs.append(Segment(FEW_SHADES[cell] * count, few))
        else:
            runs.append(Segment("▀" * count, _style(cell)))
    return runs


@lru_cache(maxsize=LEVELS * LEVELS)
def _style(cell: int) -> Style:
    top, bottom = (round(shade * 255 / (LEVELS - 1)) for shade in divmod(cell, LEVELS))
    return Style(color=Color.from_rgb(top, top, top), bgcolor=Color.from_rgb(bottom, bottom, bottom))
