"""Sharp pictures: sixels (encoded by textual-image, the extra `pictures`), or kitty's graphics protocol.

xterm, foot, WezTerm, Konsole and iTerm2 draw sixels. Of kitty's protocol only Unicode placeholders are used:
letters in which the terminal shows the image, so that other letters in their place wipe it out.
"""

from __future__ import annotations

import base64
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
from rich.color import Color
from rich.console import Console, RenderableType
from rich.segment import ControlType, Segment
from rich.style import Style
from textual.geometry import Size
from textual.strip import Strip

from station.tui.themes import TERMINAL, chosen_theme

SWITCH = "STATION_PICTURES"
"""`blocks`: never; `sharp`: over ssh too, where STOP's key and every picture share one line."""
SHARE = 0.04
"""Largest share of one core for drawing images: the dearer one is, the seldomer they come."""
PERIOD_S = 0.5
"""Between two pictures at least: the terminal has to draw them too."""
GREYS = 16
"""Time and bytes of a sixel picture grow with its shades: 46 kB for 400×320 in 16, 186 kB in 256."""
ANSWER_S = 1.0
_KITTY_ID = 0x5741
"""Number of the one image that kitty holds for this screen: the next one takes its place."""
_VERSION = re.compile(rb"\x1bP>\|(?:kitty\((\d+)\.(\d+)|ghostty)")
_KITTY_LETTERS = (0, 28)
"""From this version on kitty shows images in letters."""
_ATTRIBUTES = re.compile(rb"\x1b\[\?([0-9;]*)c")
_GREEN, _BLACK = (0, 230, 0), (0, 0, 0)
_HIDDEN = ((ControlType.CURSOR_FORWARD, 0),)
"""Marks a segment that takes no cells; what it says stands in its text."""


def detect() -> Graphics | None:
    """Ask the terminal what it draws; None: half blocks. Only before the screen reads its keys."""
    wish = os.environ.get(SWITCH, "")
    remote = "SSH_TTY" in os.environ or "SSH_CONNECTION" in os.environ
    if wish == "blocks" or (remote and wish != "sharp") or chosen_theme() == TERMINAL:
        return None
    keys, glass = sys.__stdin__, sys.__stdout__
    if keys is None or glass is None or not keys.isatty() or cell_pixels() is None:
        return None
    sixels, kitty = _drawn_by(keys.fileno(), glass.fileno())
    image = _sixel_image() if sixels else None
    return Graphics(image) if image is not None or kitty else None


def _drawn_by(stdin: int, stdout: int) -> tuple[bool, bool]:
    """Tell whether it draws sixels, and kitty's images in letters.

    The first by the terminal's device attributes, which every terminal tells; 4 stands for sixels. The second
    by its name and version, which it tells before that; the others pass over the question.
    """
    before = termios.tcgetattr(stdin)
    answer = b""
    try:
        tty.setcbreak(stdin, termios.TCSANOW)
        os.write(stdout, b"\x1b[>q\x1b[c")
        give_up_s = time.monotonic() + ANSWER_S
        while not (found := _ATTRIBUTES.search(answer)):
            # An answer that comes later still, Textual takes for what it is.
            if not select.select([stdin], [], [], max(0.0, give_up_s - time.monotonic()))[0]:
                return False, False
            answer += os.read(stdin, 1024)
    finally:
        termios.tcsetattr(stdin, termios.TCSANOW, before)
    named = _VERSION.search(answer)
    letters = named is not None and (named[1] is None or (int(named[1]), int(named[2])) >= _KITTY_LETTERS)
    return b"4" in found.group(1).split(b";"), letters


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
    """Turns pictures into what the terminal draws.

    `image` is `textual_image.renderable.SixelImage`; None: kitty's protocol.
    """

    def __init__(self, image: Callable[..., RenderableType] | None) -> None:
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
        begun_s = time.thread_time()
        room = size if self._image is not None else Size(size.width, min(size.height, len(_ROWS)))
        indexed = self._indexed(picture, corners, room)
        columns, rows = indexed.shape[1] // self._cell[0], indexed.shape[0] // self._cell[1]
        data = self._sixels(indexed, columns, rows) if self._image else _kitty_image(indexed, columns, rows)
        return SharpPicture(size, columns, rows, data, time.thread_time() - begun_s, self._image is None)

    def _sixels(self, indexed: NDArray[np.uint8], columns: int, rows: int) -> str:
        from PIL import Image  # comes with textual-image

        assert self._image is not None
        flat = Image.fromarray(indexed)
        flat.putpalette(_palette())
        options = self._console.options.update(width=columns, height=rows)
        segments = self._console.render(self._image(flat, width=columns, height=rows), options)
        return "".join(segment.text for segment in segments if segment.text.startswith("\x1bP"))

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
    data: str
    """Control sequences that bring it to the terminal."""
    spent_s: float
    """CPU time that drawing it took."""
    in_letters: bool = False
    """It shows in placeholder letters (kitty); else it is drawn where the cursor stands."""

    def strips(self, x: int, y: int, style: Style) -> list[Strip]:
        """The widget's lines when its corner stands at `x`, `y` of the terminal."""
        width, left = self.size.width, (self.size.width - self.columns) // 2
        sides = [Segment(" " * room, style) for room in (left, width - left - self.columns)]
        strips = [Strip([sides[0], self._middle(row), sides[1]], width) for row in range(self.rows)]
        strips += [Strip.blank(width, style)] * (self.size.height - self.rows)
        # Letters wipe out what lies under them: the picture comes after the last line.
        there = f"\x1b7\x1b[{y + 1};{x + left + 1}H{self.data}\x1b8"
        strips[-1] = Strip([*strips[-1], Segment(there, None, _HIDDEN)], width)
        return strips

    def _middle(self, row: int) -> Segment:
        if not self.in_letters:  # nothing is written where the picture goes: it would flicker
            return Segment(f"\x1b[{self.columns}C", None, _HIDDEN)
        # The first letter tells row and column; those after it are the next columns.
        letters = f"{_PLACEHOLDER}{_ROWS[row]}{_ROWS[0]}{_PLACEHOLDER * (self.columns - 1)}"
        return Segment(letters, Style(color=Color.from_rgb(*_KITTY_ID.to_bytes(3, "big"))))


_PLACEHOLDER = "\U0010eeee"
_ROWS = "".join(
    map(
        chr,
        (
            0x305, 0x30D, 0x30E, 0x310, 0x312, 0x33D, 0x33E, 0x33F, 0x346, 0x34A, 0x34B, 0x34C, 0x350, 0x351,
            0x352, 0x357, 0x35B, 0x363, 0x364, 0x365, 0x366, 0x367, 0x368, 0x369, 0x36A, 0x36B, 0x36C, 0x36D,
            0x36E, 0x36F, 0x483, 0x484, 0x485, 0x486, 0x487, 0x592, 0x593, 0x594, 0x595, 0x597, 0x598, 0x599,
            0x59C, 0x59D, 0x59E, 0x59F, 0x5A0, 0x5A1, 0x5A8, 0x5A9, 0x5AB, 0x5AC, 0x5AF, 0x5C4, 0x610, 0x611,
            0x612, 0x613, 0x614, 0x615, 0x616, 0x617, 0x657, 0x658, 0x659, 0x65A, 0x65B, 0x65D, 0x65E, 0x6D6,
        ),
    )
)  # fmt: skip
"""Marks that count rows and columns, from 0 (kitty: graphics protocol, Unicode placeholders)."""
_CHUNK = 4096
"""Letters of one message, at most."""


def _kitty_image(indexed: NDArray[np.uint8], columns: int, rows: int) -> str:
    """The image as PNG in messages, and where it belongs: letters with its id as their colour."""
    colours = np.array(_palette(), dtype=np.uint8).reshape(-1, 3)[:, ::-1]
    _, png = cv2.imencode(".png", colours[indexed])
    left = base64.b64encode(png.tobytes()).decode()
    messages, keys = [], f"i={_KITTY_ID},f=100,q=2,"
    while left:
        part, left = left[:_CHUNK], left[_CHUNK:]
        messages.append(f"\x1b_G{keys}m={int(bool(left))};{part}\x1b\\")
        keys = ""
    return "".join(messages) + f"\x1b_Ga=p,U=1,i={_KITTY_ID},c={columns},r={rows},q=2\x1b\\"


def _palette() -> list[int]:
    """Red, green, blue of every index."""
    ramp = [(value,) * 3 for value in np.linspace(0, 255, GREYS).round().astype(int).tolist()]
    return [part for colour in [*ramp, _GREEN, _BLACK] for part in colour]
