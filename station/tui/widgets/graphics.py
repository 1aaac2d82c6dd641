"""Sharp pictures on terminals that draw sixels, encoded by textual-image (the extra `pictures`)."""

from __future__ import annotations

import fcntl
import importlib
import os
import re
import select
import struct
import sys
import termios
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console, RenderableType
from rich.segment import ControlType, Segment
from rich.style import Style
from textual.geometry import Size
from textual.strip import Strip

from station.tui.themes import ANSI_THEMES, chosen_theme

SWITCH = "STATION_PICTURES"
"""`blocks`: never; `sharp`: over ssh too, where STOP's key and every picture share one line."""
SHARE = 0.04
"""Largest share of one core for drawing images: the dearer one is, the seldomer they come."""
PERIOD_S = 0.5
"""Between two pictures at least: the terminal has to draw them too."""
GREYS = 16
"""Time and bytes of a sixel picture grow with its shades: 46 kB for 400×320 in 16, 186 kB in 256."""
ANSWER_S = 1.0
_ATTRIBUTES = re.compile(rb"\x1b\[\?([0-9;]*)c")
_GREEN, _BLACK = (0, 230, 0), (0, 0, 0)
_HIDDEN = ((ControlType.CURSOR_FORWARD, 0),)
"""Marks a segment that takes no cells; what it says stands in its text."""


def detect() -> Graphics | None:
    """Ask the terminal what it draws; None: half blocks. Only before the screen reads its keys."""
    wish = os.environ.get(SWITCH, "")
    remote = "SSH_TTY" in os.environ or "SSH_CONNECTION" in os.environ
    if wish == "blocks" or (remote and wish != "sharp") or chosen_theme() in ANSI_THEMES:
        return None
    keys, glass = sys.__stdin__, sys.__stdout__
    if keys is None or glass is None or not keys.isatty() or cell_pixels() is None:
        return None
    if not _draws_sixels(keys.fileno(), glass.fileno()):
        return None
    image = _sixel_image()
    return None if image is None else Graphics(image)


def _draws_sixels(stdin: int, stdout: int) -> bool:
    """By the terminal's device attributes, which every terminal tells; 4 stands for sixels."""
    before = termios.tcgetattr(stdin)
    answer = b""
    try:
        tty.setcbreak(stdin, termios.TCSANOW)
        os.write(stdout, b"\x1b[c")
        give_up_s = time.monotonic() + ANSWER_S
        while not (found := _ATTRIBUTES.search(answer)):
            # An answer that comes later still, Textual takes for what it is.
            if not select.select([stdin], [], [], max(0.0, give_up_s - time.monotonic()))[0]:
                return False
            answer += os.read(stdin, 1024)
    finally:
        termios.tcsetattr(stdin, termios.TCSANOW, before)
    return b"4" in found.group(1).split(b";")


def _sixel_image() -> Callable[..., RenderableType] | None:
    """textual-image's class; None when it is not installed.

    The library asks the terminal while it is imported, waits a tenth of a second for each letter, and leaves
    what comes later to be read as keys: it is told that there is no terminal.
    """
    terminal, sys.__stdout__ = sys.__stdout__, None  # type: ignore[misc]
    try:
        image: Callable[..., RenderableType] = importlib.import_module("textual_image.renderable").SixelImage
        return image
    except ImportError:
        return None
    finally:
        sys.__stdout__ = terminal  # type: ignore[misc]


def cell_pixels() -> tuple[int, int] | None:
    """Width and height of one character; None when the terminal does not tell."""
    try:
        answer = fcntl.ioctl(sys.__stdout__ or 1, termios.TIOCGWINSZ, bytes(8))
    except OSError:
        return None
    rows, columns, width, height = struct.unpack("HHHH", answer)
    return (width // columns, height // rows) if width and height and rows and columns else None


class Graphics:
    """Turns pictures into sixels. `image` is `textual_image.renderable.SixelImage`."""

    def __init__(self, image: Callable[..., RenderableType]) -> None:
        self._image = image
        self._cell = cell_pixels() or (10, 20)
        self._console = Console()

    def ready(self) -> bool:
        """False once the letters have another size: textual-image measures them only once."""
        return cell_pixels() == self._cell

    def pixels(self, size: Size) -> tuple[int, int]:
        """Width and height of `size` cells."""
        return size.width * self._cell[0], size.height * self._cell[1]

    def draw(self, picture: NDArray[np.uint8], corners: NDArray[np.float64], size: Size) -> SharpPicture:
        """Draw an image into `size` cells. `corners`: (n, 2), shares of the sides. For a thread."""
        from PIL import Image  # comes with textual-image

        begun_s = time.thread_time()
        indexed = self._indexed(picture, corners, size)
        columns, rows = indexed.shape[1] // self._cell[0], indexed.shape[0] // self._cell[1]
        flat = Image.fromarray(indexed)
        flat.putpalette(_palette())
        options = self._console.options.update(width=columns, height=rows)
        segments = self._console.render(self._image(flat, width=columns, height=rows), options)
        sixels = "".join(segment.text for segment in segments if segment.text.startswith("\x1bP"))
        return SharpPicture(size, columns, rows, sixels, time.thread_time() - begun_s)

    def _indexed(
        self, picture: NDArray[np.uint8], corners: NDArray[np.float64], size: Size
    ) -> NDArray[np.uint8]:
        """Whole cells of palette indices: greys, the last two for the corners' crosses and their rims."""
        height, width = picture.shape
        room = self.pixels(size)
        scale = min(room[0] / width, room[1] / height)
        shape = max(1, int(width * scale)), max(1, int(height * scale))
        small = cv2.resize(picture, shape, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        across, down = (-(-pixels // cell) * cell for pixels, cell in zip(shape, self._cell, strict=True))
        left, top = (across - shape[0]) // 2, (down - shape[1]) // 2
        whole = np.zeros((down, across), dtype=np.uint8)
        whole[top : top + shape[1], left : left + shape[0]] = small.astype(int) * GREYS // 256
        for x, y in corners:
            at = round(left + x * shape[0]), round(top + y * shape[1])
            for index, thickness in ((GREYS + 1, 3), (GREYS, 1)):
                cv2.drawMarker(whole, at, index, cv2.MARKER_CROSS, 9 + thickness, thickness)
        return whole


@dataclass(frozen=True)
class SharpPicture:
    """A picture of `columns` × `rows` cells, in the middle of a widget of `size`."""

    size: Size
    columns: int
    rows: int
    sixels: str
    spent_s: float
    """CPU time that drawing it took."""

    def strips(self, x: int, y: int, style: Style) -> list[Strip]:
        """The widget's lines when its corner stands at `x`, `y` of the terminal."""
        width, left = self.size.width, (self.size.width - self.columns) // 2
        # Nothing is written where the picture goes: it would flicker.
        step = Segment(f"\x1b[{self.columns}C", None, _HIDDEN)
        sides = [Segment(" " * room, style) for room in (left, width - left - self.columns)]
        strips = [Strip([sides[0], step, sides[1]], width)] * self.rows
        strips += [Strip.blank(width, style)] * (self.size.height - self.rows)
        # Letters wipe out what lies under them: the picture comes after the last line.
        there = f"\x1b7\x1b[{y + 1};{x + left + 1}H{self.sixels}\x1b8"
        strips[-1] = Strip([*strips[-1], Segment(there, None, _HIDDEN)], width)
        return strips


def _palette() -> list[int]:
    """Red, green, blue of every index."""
    ramp = [(value,) * 3 for value in np.linspace(0, 255, GREYS).round().astype(int).tolist()]
    return [part for colour in [*ramp, _GREEN, _BLACK] for part in colour]
