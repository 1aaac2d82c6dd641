"""Sharp pictures: only on a terminal that says it draws them, never over a question or a notice."""

from __future__ import annotations

import base64
import fcntl
import os
import pty
import re
import struct
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from rich.style import Style
from textual._compositor import Compositor
from textual._xterm_parser import XTermParser
from textual.geometry import Region, Size
from textual.pilot import Pilot

from station.protocol import verbs
from station.tui.app import StationApp
from station.tui.dialogs import ConfirmMotion
from station.tui.widgets import graphics as graphics_module
from station.tui.widgets.graphics import SWITCH, Graphics, SharpPicture, detect
from station.tui.widgets.preview import PreviewPane
from tests.tui.conftest import FakeLink, app_on, idle, opened, until

CELL = (8, 17)
VT340 = b"\x1b[?63;1;2;4;6;9;15;22c"
PLAIN = b"\x1b[?62;22c"
KITTY, OLD_KITTY, GHOSTTY = (
    b"\x1bP>|kitty(0.41.1)\x1b\\",
    b"\x1bP>|kitty(0.26.5)\x1b\\",
    b"\x1bP>|ghostty 1.1.3\x1b\\",
)
"""Of the first the answer of a real one, 0.41.1, was seen."""


@pytest.fixture
def sixels(monkeypatch: pytest.MonkeyPatch) -> Graphics:
    monkeypatch.setattr(graphics_module, "cell_pixels", lambda: CELL)
    monkeypatch.setattr("textual_image.renderable.sixel.get_cell_size", lambda: _cell_size())
    image = graphics_module._sixel_image()
    assert image is not None, "the extra `pictures` is installed for the tests"
    return Graphics(image)


def _cell_size() -> object:
    from textual_image._terminal import CellSize

    return CellSize(*CELL)


def sharp_app(link: FakeLink, graphics: Graphics) -> StationApp:
    PreviewPane.graphics = graphics
    return app_on(link)


@pytest.fixture(autouse=True)
def blocks_again() -> Iterator[None]:
    yield
    PreviewPane.graphics = None


def lines_of(pilot: Pilot[None]) -> list[str]:
    """Give what the preview would write to the terminal, control sequences included."""
    preview = pilot.app.screen_stack[0].query_one(PreviewPane)
    strips = preview.render_lines(Region(0, 0, *preview.size))
    return ["".join(segment.text for segment in strip) for strip in strips]


def sharp(pilot: Pilot[None]) -> bool:
    return any("\x1bP" in line for line in lines_of(pilot))


async def test_the_picture_fills_whole_cells_and_comes_after_the_last_line(
    link: FakeLink, sixels: Graphics
) -> None:
    async with sharp_app(link, sixels).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: sharp(pilot))
        preview = pilot.app.screen.query_one(PreviewPane)
        *others, last = lines_of(pilot)
        assert len(others) + 1 == preview.size.height
        assert not any("\x1bP" in line for line in others)
        found = re.search(r'\x1b7\x1b\[(\d+);(\d+)H\x1bP.*?q"1;1;(\d+);(\d+)', last)
        assert found is not None
        row, column, width, height = map(int, found.groups())
        assert (width % CELL[0], height % CELL[1]) == (0, 0)
        assert row - 1 == preview.region.y
        assert column - 1 + width // CELL[0] <= preview.region.right
        assert height // CELL[1] <= preview.size.height
        # Between the sides nothing is written: the cursor steps over the picture.
        assert others[0].replace(f"\x1b[{width // CELL[0]}C", "").strip() == ""


async def test_half_blocks_while_something_stands_over_it(link: FakeLink, sixels: Graphics) -> None:
    async with sharp_app(link, sixels).run_test(size=(80, 24), notifications=True) as pilot:
        await until(pilot, lambda: sharp(pilot))
        pilot.app.notify("something happened", timeout=0.5)
        await until(pilot, lambda: not sharp(pilot))
        await until(pilot, lambda: sharp(pilot))
        await pilot.press("f5")
        await until(pilot, lambda: isinstance(pilot.app.screen, ConfirmMotion))
        assert not sharp(pilot)
        assert any("▀" in line for line in lines_of(pilot))


async def test_and_when_the_letters_change_their_size(
    link: FakeLink, sixels: Graphics, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with sharp_app(link, sixels).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: sharp(pilot))
        monkeypatch.setattr(graphics_module, "cell_pixels", lambda: (12, 25))
        assert not sharp(pilot)


async def test_a_dear_picture_makes_the_next_one_wait(
    link: FakeLink, sixels: Graphics, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Size] = []

    def dear(_picture: object, _corners: object, size: Size) -> SharpPicture:
        drawn.append(size)
        return SharpPicture(size, 10, 5, "\x1bPq\x1b\\", spent_s=100.0)

    monkeypatch.setattr(sixels, "draw", dear)
    async with sharp_app(link, sixels).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: drawn)
        asked = sum(isinstance(verb, verbs.Preview) for verb in link.asked)
        await until(pilot, lambda: sum(isinstance(verb, verbs.Preview) for verb in link.asked) >= asked + 3)
        assert len(drawn) == 1


def test_kitty_shows_the_image_in_letters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphics_module, "cell_pixels", lambda: CELL)
    grey = np.full((100, 80), 128, dtype=np.uint8)
    picture = Graphics(None).draw(grey, np.array([[0.5, 0.5]]), Size(30, 12))
    *above, last = picture.strips(4, 2, Style())
    for row, strip in enumerate([*above, last][: picture.rows]):
        letters = list(strip)[1]
        assert letters.text.count("\U0010eeee") == picture.columns == letters.cell_length
        assert letters.text[1] == graphics_module._ROWS[row]
    assert all(strip.cell_length == 30 for strip in (*above, last)) and len(above) == 11
    messages = re.findall(r"\x1b_G([^;\x1b]*);?([^\x1b]*)\x1b\\", list(last)[-1].text)
    png = base64.b64decode("".join(payload for _, payload in messages))
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None and shown.shape[:2] == (picture.rows * CELL[1], picture.columns * CELL[0])
    assert (shown == (0, 230, 0)).all(axis=2).any(), "the corner's cross"
    assert f"U=1,i={graphics_module._KITTY_ID},c={picture.columns},r={picture.rows}" in messages[-1][0]


def test_corners_are_crosses_and_not_only_a_colour(sixels: Graphics) -> None:
    grey = np.full((50, 40), 128, dtype=np.uint8)
    without = sixels._indexed(grey, np.zeros((0, 2)), Size(10, 6))
    with_one = sixels._indexed(grey, np.array([[0.5, 0.5]]), Size(10, 6))
    middle = with_one[51 - 3 : 51 + 4, 40 - 3 : 40 + 4]
    assert (middle[3] == graphics_module.GREYS).all()
    assert (middle[:, 3] == graphics_module.GREYS).all()
    assert middle[0, 0] == without[48, 37]


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The other end of a terminal of 80×24 cells of 10×20 pixels; this process sits at it."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 800, 480))
    with open(slave, "r+b", buffering=0) as both:  # noqa: PTH123  (a descriptor, not a path)
        for name in ("__stdin__", "__stdout__"):
            monkeypatch.setattr(sys, name, both)
        for name in ("SSH_TTY", "SSH_CONNECTION", SWITCH, "TEXTUAL_THEME"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("TERM", "xterm-256color")
        yield master
    os.close(master)


def answer(terminal: int, *parts: bytes) -> threading.Thread:
    """Answer once asked, like a terminal."""

    def work() -> None:
        if b"\x1b[c" in os.read(terminal, 100):
            for part in parts:
                os.write(terminal, part)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


@pytest.mark.parametrize(
    ("parts", "sharp"),
    [
        ((VT340,), True),
        ((VT340[:7], VT340[7:]), True),
        ((b"x", VT340), True),
        ((PLAIN,), False),
        ((KITTY, PLAIN), True),
        ((GHOSTTY, PLAIN), True),
        ((OLD_KITTY, PLAIN), False),
    ],
)
def test_the_terminal_is_asked(terminal: int, parts: tuple[bytes, ...], sharp: bool) -> None:
    asked = answer(terminal, *parts)
    assert (detect() is not None) is sharp
    asked.join()


@pytest.mark.parametrize(
    ("name", "value"),
    [(SWITCH, "blocks"), ("SSH_TTY", "/dev/pts/3"), ("TERM", "linux"), ("TEXTUAL_THEME", "terminal")],
)
def test_where_half_blocks_are_wanted_it_is_not_even_asked(
    terminal: int, name: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    assert detect() is None
    os.set_blocking(terminal, False)
    with pytest.raises(BlockingIOError):
        os.read(terminal, 1)


def test_over_ssh_for_who_asks_for_it(terminal: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSH_TTY", "/dev/pts/3")
    monkeypatch.setenv(SWITCH, "sharp")
    asked = answer(terminal, VT340)
    assert detect() is not None
    asked.join()


def test_a_silent_terminal_gets_half_blocks(terminal: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphics_module, "ANSWER_S", 0.05)
    assert detect() is None


def test_an_answer_that_comes_late_presses_no_key() -> None:
    assert list(XTermParser().feed(VT340.decode())) == []


def test_without_the_extra_nothing_is_missed(
    terminal: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "textual_image.renderable", None)
    asked = answer(terminal, VT340)
    assert detect() is None
    asked.join()


async def test_a_status_repaints_only_what_it_changes(
    link: FakeLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    link.same_image = True
    updates: list[str] = []
    render = Compositor.render_update

    def noted(self: Compositor, *args: Any, **more: Any) -> Any:
        update = render(self, *args, **more)
        updates.append(type(update).__name__)
        return update

    async with opened(link, size=(160, 48)) as pilot:
        await pilot.pause(1.0)
        monkeypatch.setattr(Compositor, "render_update", noted)
        status = idle()
        link.show(msgspec.structs.replace(status, robot=msgspec.structs.replace(status.robot, rate_hz=7.0)))
        await until(pilot, lambda: updates)
        await pilot.pause(0.3)
        assert "LayoutUpdate" not in updates


async def test_until_the_next_picture_is_due_only_the_smallest_is_asked_for(link: FakeLink) -> None:
    async with app_on(link).run_test(size=(160, 48)) as pilot:
        preview = pilot.app.screen.query_one(PreviewPane)
        await until(pilot, lambda: preview._image is not None)
        shown = preview._image
        preview._next_s = time.monotonic() + 3600.0
        link.asked.clear()
        await preview.fetch(link)  # what the daemon finds in it is still told by the status
        assert link.asked[-1] == verbs.Preview(16, 16)
        assert preview._image is shown
        preview._next_s = 0.0
        await preview.fetch(link)
        assert isinstance(asked := link.asked[-1], verbs.Preview) and asked.width > 16
        assert preview._image is not shown
