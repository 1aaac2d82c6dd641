"""The camera's picture in half blocks, with the found corners drawn on it. Works on any terminal."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.segment import Segment
from rich.style import Style
from textual.geometry import Size
from textual.strip import Strip
from textual.widget import Widget

Grey = NDArray[np.uint8]
CORNER_RGB = (0, 230, 0)


class Preview(Widget):
    """Shows the last picture it was given; scales with its own size, keeps the aspect ratio."""

    DEFAULT_CSS = "Preview { width: 1fr; height: 1fr; }"

    def __init__(self, *, id: str | None = None) -> None:
        super().__init__(id=id)
        self._picture: Grey | None = None
        self._corners: NDArray[np.float64] = np.zeros((0, 2))
        self._rows: list[Strip] = []
        self._rows_size = Size(0, 0)

    def show(self, answer: dict[str, Any]) -> None:
        """A `preview` reply: jpeg_base64, and corners as fractions of width and height."""
        data = np.frombuffer(base64.b64decode(answer.get("jpeg_base64", "")), dtype=np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
        if picture is None:
            return
        self._picture = np.asarray(picture, dtype=np.uint8)
        self._corners = np.array(answer.get("corners", []), dtype=float).reshape(-1, 2)
        self._rows_size = Size(0, 0)
        self.refresh()

    def render_line(self, y: int) -> Strip:
        if self._rows_size != self.size:
            self._rows, self._rows_size = self._draw(self.size), self.size
        return self._rows[y] if y < len(self._rows) else Strip.blank(self.size.width)

    def _draw(self, size: Size) -> list[Strip]:
        if self._picture is None or size.width < 2 or size.height < 1:
            return [Strip([Segment("no picture yet".center(size.width))])] if size.width else []
        height, width = self._picture.shape
        # A cell is one pixel wide and two high.
        scale = min(size.width / width, 2 * size.height / height)
        columns, rows = max(1, int(width * scale)), max(2, int(height * scale) // 2 * 2)
        small = cv2.resize(self._picture, (columns, rows), interpolation=cv2.INTER_AREA)
        rgb = np.repeat(small[:, :, None], 3, axis=2)
        for x, y in self._corners:
            row, column = int(y * rows), int(x * columns)
            if 0 <= row < rows and 0 <= column < columns:
                rgb[row, column] = CORNER_RGB
        left = (size.width - columns) // 2
        return [self._strip(rgb[r], rgb[r + 1], left, size.width) for r in range(0, rows, 2)]

    @staticmethod
    def _strip(top: NDArray[Any], bottom: NDArray[Any], left: int, width: int) -> Strip:
        cells = [Segment(" " * left)]
        for a, b in zip(top, bottom, strict=True):
            ink, paper = (f"rgb({p[0]},{p[1]},{p[2]})" for p in (a, b))
            cells.append(Segment("▀", Style.parse(f"{ink} on {paper}")))
        return Strip(cells).adjust_cell_length(width)
