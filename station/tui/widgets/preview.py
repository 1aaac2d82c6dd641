"""The camera's image and its found corners: block characters, or sharp where the terminal can draw that."""

from __future__ import annotations

import base64
import importlib
import os
import sys
import termios
import time
from functools import lru_cache
from itertools import groupby
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.segment import Segment
from rich.style import Style
from textual.app import ComposeResult
from textual.geometry import Size
from textual.reactive import reactive
from textual.strip import Strip
from textual.theme import Theme
from textual.widget import Widget

from station.cell.status import OLD_S
from station.protocol import verbs
from station.protocol.client import Client
from station.tui.themes import TERMINAL, chosen_theme

SHARP_S = 1.0
"""Between two sharp images at least: drawing one takes up to 0.1 s of the processor."""
LEVELS = 20
"""Shades a terminal image is drawn with: fewer styles to send, and no eye sees more in blocks."""
GREYS = 16
"""Shades of a sharp image: its bytes grow with them."""
QUADRANTS = " ▘▝▀▖▌▞▛▗▚▐▜▄▙▟█"
"""Two by two picture elements: bit 0 is the upper left one, 1 the upper right one, 2 and 3 those below."""
_BITS = 1 << np.arange(4)
_FULL = len(QUADRANTS) - 1
"""Cell of one shade: its character and its background are alike."""
_CORNER, _WANTED = -1, -2
"""Cells that show a corner, or where few colours are drawn the wanted view's outline, in place of shades."""
_LINE = LEVELS
"""The shade after the last: that of the wanted view's outline."""
_BLACK = Color.from_rgb(0, 0, 0)
YELLOW = Color.from_rgb(255, 200, 0)
SIGNS = {
    _CORNER: Segment("+", Style(color=Color.from_rgb(0, 230, 0), bgcolor=_BLACK, bold=True)),
    _WANTED: Segment("o", Style(color=YELLOW, bgcolor=_BLACK, bold=True)),
}
"""Signs, and not only colours."""
OLD = "OLD IMAGE"
Outline = tuple[tuple[float, float], ...]
FEW_SHADES = " ░▒▓█"
"""Shades of a console with 16 colours, whose backgrounds have no greys: one a cell, dithered."""
_BAYER = (np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) + 0.5) / 16
"""Thresholds of ordered dithering. True greys are not dithered: each cell would need a style of its own."""


def sharp_widget() -> Any:
    """Return textual-image's widget; None where it is missing, not wanted, or the terminal draws no images.

    The library asks the terminal when it is imported: only before the screen reads its keys.
    """
    remote = "SSH_TTY" in os.environ or "SSH_CONNECTION" in os.environ
    keys, glass = sys.__stdin__, sys.__stdout__
    if remote or chosen_theme() == TERMINAL:  # over ssh STOP's key and every picture share one line
        return None
    if keys is None or glass is None or not keys.isatty() or not glass.isatty():
        return None
    try:
        drawn = importlib.import_module("textual_image.renderable")
        widget = importlib.import_module("textual_image.widget").Image
    except ImportError:
        return None
    finally:
        termios.tcflush(keys, termios.TCIFLUSH)  # an answer that came late would be read as keys
    return widget if drawn.Image in (drawn.SixelImage, drawn.TGPImage) else None


class PreviewPane(Widget):
    """The last image it was given; scales with its own size, keeps the aspect ratio."""

    DEFAULT_CSS = """
    PreviewPane { width: 1fr; height: 1fr; align: center top; }
    PreviewPane > * { display: none; height: auto; }
    """

    sharp: ClassVar[Any] = None
    """The widget for sharp images; None: blocks only."""
    old: reactive[bool] = reactive(False)
    """The image is out of date; written across it."""
    dated: reactive[bool] = reactive(False)
    """The daemon has had no newer image for seconds, as while it is at other work."""
    wanted: reactive[Outline] = reactive(())
    """Corners of the board in the wanted view, in order, as shares of the image's sides; drawn as a line."""
    calm: reactive[bool] = reactive(True)
    """The arm rests. While it works nothing that takes long to draw may make STOP wait."""

    def __init__(self, *, id: str | None = None) -> None:
        super().__init__(id=id)
        self._image: NDArray[np.uint8] | None = None
        self._sequence: int | None = None
        self._corners: NDArray[np.float64] = np.zeros((0, 2))
        self._rows: list[Strip] = []
        self._rows_size = Size(0, 0)
        self._next_s = 0.0
        """Time before which no sharp image is drawn."""

    def on_mount(self) -> None:
        self.app.theme_changed_signal.subscribe(self, self._draw_in)

    def _draw_in(self, theme: Theme) -> None:
        """Draw again, in the colours of another theme."""
        self._rows_size = Size(0, 0)
        self.refresh()

    def compose(self) -> ComposeResult:
        if self.sharp is not None:
            yield self.sharp()

    async def fetch(self, link: Client) -> None:
        """Ask for an image and show it, where one may be drawn already."""
        if not self._sharp() or time.monotonic() >= self._next_s:
            self.show(await link.call(verbs.Preview(*self.wanted_pixels())))

    def show(self, answer: verbs.PreviewImage) -> None:
        """Show an image, if there is one and it does not stand there already."""
        self.dated = answer.age_s > OLD_S
        if answer.sequence == self._sequence or not answer.jpeg_base64:
            return
        data = np.frombuffer(base64.b64decode(answer.jpeg_base64), dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        if image is None:
            return
        self._image, self._sequence = np.asarray(image, dtype=np.uint8), answer.sequence
        self._corners = np.array(answer.corners, dtype=float).reshape(-1, 2)
        self._rows_size = Size(0, 0)
        self._sharpen()
        self.refresh()

    def _sharp(self) -> bool:
        """Tell whether a sharp image may stand here: it would hide what is drawn over it."""
        if self.sharp is None or self._stale or not self.calm or not self.screen.is_active:
            return False
        return not any(part.display for part in self.screen.query("Toast, Tooltip, Stopped"))

    def _sharpen(self) -> None:
        if self._image is None or not self._sharp():
            self.soften()
            return
        from PIL import Image  # comes with textual-image

        shades = self._image.astype(int) * GREYS // 256 * (255 // (GREYS - 1))
        coloured = cv2.cvtColor(shades.astype(np.uint8), cv2.COLOR_GRAY2RGB)
        height, width = self._image.shape
        for place in np.rint(self._corners * (width, height)).astype(int).tolist():
            cv2.drawMarker(coloured, place, (0, 0, 0), cv2.MARKER_CROSS, 9, 3)
            cv2.drawMarker(coloured, place, (0, 230, 0), cv2.MARKER_CROSS, 7, 1)
        self._outline(coloured, (0, 0, 0), 5)
        self._outline(coloured, (255, 200, 0), 2)
        across, down = self._cell()
        scale = min(self.size.width * across / width, self.size.height * down / height)
        child: Any = self.children[0]
        child.image = Image.fromarray(coloured)
        child.styles.width, child.display = max(1, int(width * scale) // across), True
        self._next_s = time.monotonic() + SHARP_S

    def _outline(self, image: cv2.typing.MatLike, colour: tuple[int, ...], thickness: int = 1) -> None:
        """Draw the wanted view's outline into an image."""
        if self.wanted:
            places = np.rint(np.array(self.wanted) * image.shape[1::-1]).astype(np.int32)
            cv2.polylines(image, [places], True, colour, thickness)

    def soften(self) -> None:
        """Show blocks: a sharp image would hide what is drawn over it."""
        for child in self.children:
            child.display = False

    @property
    def _stale(self) -> bool:
        return self.old or self.dated

    def watch_old(self) -> None:
        self.soften()

    def watch_dated(self) -> None:
        self._rows_size = Size(0, 0)  # without the corners
        self.soften()

    def watch_wanted(self) -> None:
        self._rows_size = Size(0, 0)

    def watch_calm(self) -> None:
        self.soften()

    def _cell(self) -> tuple[int, int]:
        """Width and height of one character in pixels, or what stands for them in blocks."""
        if not self._sharp():
            return 2, 4
        cell: tuple[int, int] = importlib.import_module("textual_image._terminal").get_cell_size()
        return cell

    def wanted_pixels(self) -> tuple[int, int]:
        """Return width and height of the largest image that this widget can show."""
        across, down = self._cell()
        return max(16, across * self.size.width), max(16, down * self.size.height)

    def render_line(self, y: int) -> Strip:
        if any(child.display for child in self.children):
            return Strip.blank(self.size.width, self.rich_style)
        if self._rows_size != self.size:
            self._rows, self._rows_size = self._draw(self.size), self.size
        if self._stale and self._image is not None and y == self.size.height // 2:
            return Strip([Segment(OLD.center(self.size.width), Style(reverse=True, bold=True))])
        return self._rows[y] if y < len(self._rows) else Strip.blank(self.size.width, self.rich_style)

    def _blocks(self, rows: int, columns: int) -> list[list[int]]:
        """Draw the image, and the wanted view's outline, in cells of `quadrants`."""
        assert self._image is not None
        across = 2 if has_quadrants() else 1
        small = cv2.resize(self._image, (across * columns, 2 * rows), interpolation=cv2.INTER_AREA)
        levels = small.astype(int) * LEVELS // 256
        lined = np.zeros(levels.shape, np.uint8)
        self._outline(lined, (1,))
        levels[lined > 0] = _LINE
        levels = np.repeat(levels, 2 // across, axis=1)
        cells = levels.reshape(rows, 2, columns, 2).swapaxes(1, 2).reshape(rows, columns, 4)
        encoded: list[list[int]] = quadrants(cells).tolist()
        return encoded

    def _dithered(self, rows: int, columns: int) -> list[list[int]]:
        """Draw the image in cells of `FEW_SHADES`, and the wanted view's outline in signs."""
        assert self._image is not None
        small = cv2.resize(self._image, (columns, rows), interpolation=cv2.INTER_AREA)
        thresholds = np.tile(_BAYER, (rows // 4 + 1, columns // 4 + 1))[:rows, :columns]
        cells = (small / 255 * (len(FEW_SHADES) - 1) + thresholds).astype(int)
        lined = np.zeros(cells.shape, np.uint8)
        self._outline(lined, (1,))
        encoded: list[list[int]] = np.where(lined > 0, _WANTED, cells).tolist()
        return encoded

    def _draw(self, size: Size) -> list[Strip]:
        if self._image is None or size.width < 2 or size.height < 1:
            words = Segment("no image yet".center(size.width), self.rich_style)
            return [Strip([words])] if size.width else []
        height, width = self._image.shape
        # A character is twice as high as it is wide.
        scale = min(size.width / width, 2 * size.height / height)
        columns = max(1, int(width * scale))
        rows = max(1, int(height * scale) // 2)
        few = None
        if self.app.current_theme.ansi:
            # White on black, so that light is light on a white terminal too.
            few = Style() if self.app.no_color else Style(color="white", bgcolor="black")
            cells = self._dithered(rows, columns)
        else:
            cells = self._blocks(rows, columns)
        for x, y in () if self.dated else self._corners:
            row = int(y * rows)
            column = int(x * columns)
            if 0 <= row < rows and 0 <= column < columns:
                cells[row][column] = _CORNER
        left = (size.width - columns) // 2
        sides = [Segment(" " * room, self.rich_style) for room in (left, size.width - columns - left)]
        return [Strip([sides[0], *_runs(line, few), sides[1]], size.width) for line in cells]


def has_quadrants() -> bool:
    """Tell whether the terminal's font has quadrants; a Linux console's has halves alone."""
    return os.environ.get("TERM") != "linux"


def quadrants(levels: NDArray[np.int_]) -> NDArray[np.int_]:
    """Make cells (rows, columns) of picture elements (rows, columns, 4) from 0 to `LEVELS` - 1, or `_LINE`.

    Each cell has two shades, the means of its elements on either side of the middle between the darkest and
    the lightest one; the outline's is the upper of the two wherever it passes. Encoded as
    (bits · (LEVELS + 1) + upper) · (LEVELS + 1) + lower.
    """
    is_line = levels == _LINE
    shades = np.where(is_line, 0, levels)
    has_line = is_line.any(axis=2, keepdims=True)
    middle = (shades.min(axis=2, keepdims=True) + shades.max(axis=2, keepdims=True)) / 2
    upper = np.where(has_line, is_line, shades > middle)
    high = _mean(shades, upper)
    low = _mean(shades, ~upper)
    high = np.where(has_line[..., 0], _LINE, np.where(upper.any(axis=2), high, low))
    bits = np.where(upper.any(axis=2), upper @ _BITS, _FULL)
    cells: NDArray[np.int_] = (bits * (LEVELS + 1) + high) * (LEVELS + 1) + low
    return cells


def _mean(shades: NDArray[np.int_], chosen: NDArray[np.bool_]) -> NDArray[np.int_]:
    """Average (rows, columns, 4) over the chosen elements of each cell; 0 where none is."""
    total = (shades * chosen).sum(axis=2)
    mean: NDArray[np.int_] = np.rint(total / np.maximum(chosen.sum(axis=2), 1)).astype(int)
    return mean


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
            bits, shades = divmod(cell, (LEVELS + 1) ** 2)
            runs.append(Segment(QUADRANTS[bits] * count, _style(shades)))
    return runs


@lru_cache(maxsize=(LEVELS + 1) ** 2)
def _style(shades: int) -> Style:
    upper, lower = (_colour(shade) for shade in divmod(shades, LEVELS + 1))
    return Style(color=upper, bgcolor=lower)


def _colour(shade: int) -> Color:
    if shade == _LINE:
        return YELLOW
    grey = round(shade * 255 / (LEVELS - 1))
    return Color.from_rgb(grey, grey, grey)
