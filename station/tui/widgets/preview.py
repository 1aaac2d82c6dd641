"""The camera's image and its found corners: half blocks on any terminal, sharp where it can draw them."""

from __future__ import annotations

import asyncio
import base64
import time
from functools import lru_cache
from itertools import groupby
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.segment import Segment
from rich.style import Style
from textual.geometry import Region, Size
from textual.reactive import reactive
from textual.strip import Strip
from textual.widget import Widget

from station.protocol import verbs
from station.protocol.client import Client
from station.tui.widgets.graphics import PERIOD_S, SHARE, Graphics, SharpPicture

Grey = NDArray[np.uint8]
LEVELS = 20
"""Shades a terminal image is drawn with: fewer styles to send, and no eye sees more in half blocks."""
_CORNER = -1
"""A cell that shows a corner in place of shades."""
CORNER = Segment("+", Style(color=Color.from_rgb(0, 230, 0), bgcolor=Color.from_rgb(0, 0, 0), bold=True))
"""A corner: a sign and not only a colour."""
OLD = "OLD IMAGE"
SMALLEST = (16, 16)
"""Pixels to ask for while no image is drawn: the daemon still looks for the board."""
FEW_SHADES = " ░▒▓█"
"""Shades of a console with 16 colours, whose backgrounds have no greys: one a cell."""


class PreviewPane(Widget):
    """The last image it was given; scales with its own size, keeps the aspect ratio.

    Half blocks are drawn whenever something may stand over the image: a terminal's own graphics hide text.
    """

    DEFAULT_CSS = "PreviewPane { width: 1fr; height: 1fr; }"

    graphics: ClassVar[Graphics | None] = None
    """The terminal's own graphics; None: half blocks only."""
    old: reactive[bool] = reactive(False)
    """The image is out of date; written across it."""

    def __init__(self, *, id: str | None = None) -> None:
        super().__init__(id=id)
        self._image: Grey | None = None
        self._sequence: int | None = None
        self._corners: NDArray[np.float64] = np.zeros((0, 2))
        self._rows: list[Strip] = []
        self._rows_size = Size(0, 0)
        self._sharp: SharpPicture | None = None
        self._next_s = 0.0
        """Time before which no image is drawn, to bound the processor's load."""

    async def fetch(self, link: Client) -> None:
        """Ask for an image and show it. What the daemon sees in it stands in the status, shown or not.

        Until the next one may be drawn the smallest will do: a large one is dear to send and to read.
        """
        due = time.monotonic() >= self._next_s
        width, height = self.wanted_pixels() if due else SMALLEST
        answer = await link.call(verbs.Preview(width, height))
        if due and answer.jpeg_base64:
            await self.show(answer)

    async def show(self, answer: verbs.PreviewImage) -> None:
        """Show an image, unless it stands there already."""
        if answer.sequence == self._sequence:
            return
        data = np.frombuffer(base64.b64decode(answer.jpeg_base64), dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        if image is None:
            return
        self._image, self._sequence = np.asarray(image, dtype=np.uint8), answer.sequence
        self._corners = np.array(answer.corners, dtype=float).reshape(-1, 2)
        self._rows_size = Size(0, 0)
        await self._sharpen(self.size)
        self.refresh()

    async def _sharpen(self, size: Size) -> None:
        graphics, self._sharp = self._graphics(), None
        if graphics is None or self._image is None:
            return
        self._sharp = await asyncio.to_thread(graphics.draw, self._image, self._corners, size)
        self._next_s = time.monotonic() + max(PERIOD_S, self._sharp.spent_s / SHARE)

    def _graphics(self) -> Graphics | None:
        """The terminal's own graphics; None while half blocks are due."""
        graphics = self.graphics
        if graphics is None or self.old or not self.screen.is_active or not graphics.ready():
            return None
        return (
            None if any(part.display for part in self.screen.query("Toast, Tooltip, Stopped")) else graphics
        )

    def wanted_pixels(self) -> tuple[int, int]:
        """Return width and height of the largest image that this widget can show: a cell is one by two."""
        if (graphics := self._graphics()) is not None:
            return graphics.pixels(self.size)
        return max(16, self.size.width), max(16, 2 * self.size.height)

    def render_lines(self, crop: Region) -> list[Strip]:
        if self._sharp is not None and crop.size == self._sharp.size == self.size and self._graphics():
            return self._sharp.strips(*self.region.offset, self.rich_style)
        return super().render_lines(crop)

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
        few = self.app.current_theme.ansi
        shades_of_a_cell = shades[:, 0] + shades[:, 1] if few else shades[:, 0] * LEVELS + shades[:, 1]
        cells = shades_of_a_cell.tolist()
        for x, y in self._corners:
            row, column = int(y * rows) // 2, int(x * columns)
            if 0 <= row < rows // 2 and 0 <= column < columns:
                cells[row][column] = _CORNER
        left = (size.width - columns) // 2
        sides = (
            Segment(" " * left, self.rich_style),
            Segment(" " * (size.width - columns - left), self.rich_style),
        )
        return [Strip([sides[0], *_runs(line, few), sides[1]], size.width) for line in cells]


def _runs(line: list[int], few: bool) -> list[Segment]:
    """Join equal neighbours: less to send over ssh."""
    runs: list[Segment] = []
    for cell, alike in groupby(line):
        count = len(list(alike))
        if cell == _CORNER:
            runs += [CORNER] * count
        elif few:
            shade = FEW_SHADES[cell * len(FEW_SHADES) // (2 * LEVELS - 1)]
            runs.append(Segment(shade * count, Style()))
        else:
            runs.append(Segment("▀" * count, _style(cell)))
    return runs


@lru_cache(maxsize=LEVELS * LEVELS)
def _style(cell: int) -> Style:
    top, bottom = (round(shade * 255 / (LEVELS - 1)) for shade in divmod(cell, LEVELS))
    return Style(color=Color.from_rgb(top, top, top), bgcolor=Color.from_rgb(bottom, bottom, bottom))
