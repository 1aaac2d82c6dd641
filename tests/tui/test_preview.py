"""The live picture: sharp only on a terminal that says it draws images, and never while STOP could wait."""

from __future__ import annotations

import os
import pty
import sys
import termios
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from textual._compositor import Compositor
from textual.pilot import Pilot

from station.cell.status import StationState
from station.tui.dialogs import ConfirmMotion
from station.tui.widgets.preview import LEVELS, QUADRANTS, YELLOW, PreviewPane, quadrants, sharp_widget
from tests.tui.conftest import FakeLink, app_on, idle, opened, until, with_robot

VT340, PLAIN = b"\x1b[?63;1;2;4;6;9;15;22c", b"\x1b[?62;22c"


@pytest.fixture
def sharp_panes(monkeypatch: pytest.MonkeyPatch) -> None:
    from textual_image.widget import SixelImage

    monkeypatch.setattr(PreviewPane, "sharp", SixelImage)


def sharp(pilot: Pilot[None]) -> bool:
    """The image is drawn into the picture's place of the lowest screen."""
    pane = pilot.app.screen_stack[0].query_one(PreviewPane)
    (child,) = pane.children
    return child.display and child.size.width > 0 and pane.region.contains_region(child.region)


@pytest.mark.usefixtures("sharp_panes")
async def test_half_blocks_while_something_stands_over_it_and_while_the_arm_works(link: FakeLink) -> None:
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await until(pilot, lambda: sharp(pilot))
        pilot.app.notify("something happened", timeout=3600)
        await until(pilot, lambda: not sharp(pilot))
        pilot.app.clear_notifications()
        await until(pilot, lambda: sharp(pilot))
        link.show(idle(StationState.MOVING))
        await until(pilot, lambda: not sharp(pilot))
        preview = pilot.app.screen.query_one(PreviewPane)
        assert set(preview.render_line(preview.size.height // 2).text) & set(QUADRANTS[1:])
        link.show(idle())
        await until(pilot, lambda: sharp(pilot))
        await pilot.press("f5")
        await until(pilot, lambda: isinstance(pilot.app.screen, ConfirmMotion))
        await until(pilot, lambda: not sharp(pilot))


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The other end of a terminal; this process sits at it and has not asked it anything yet."""
    master, slave = pty.openpty()
    termios.tcsetwinsize(slave, (24, 80))
    with os.fdopen(slave) as keys, os.fdopen(os.dup(slave), "w") as glass:
        monkeypatch.setattr(sys, "__stdin__", keys)
        monkeypatch.setattr(sys, "__stdout__", glass)
        for name in ("SSH_TTY", "SSH_CONNECTION", "TEXTUAL_THEME"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("TERM", "xterm-256color")
        for name in [name for name in sys.modules if name.startswith("textual_image")]:
            monkeypatch.delitem(sys.modules, name)
        yield master
    os.close(master)


@pytest.mark.parametrize(("answer", "drawn"), [(VT340, True), (PLAIN, False)])
def test_the_terminal_is_asked(terminal: int, answer: bytes, drawn: bool) -> None:
    def work() -> None:
        if b"\x1b[c" in os.read(terminal, 100):
            os.write(terminal, answer)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    widget = sharp_widget()
    thread.join()
    # textual-image names its sixel widget `Image`, too.
    assert ("sixel" in widget.__module__ if widget is not None else False) is drawn


@pytest.mark.parametrize(
    ("name", "value"),
    [("SSH_TTY", "/dev/pts/3"), ("TERM", "linux"), ("TEXTUAL_THEME", "terminal")],
)
def test_where_half_blocks_are_wanted_it_is_not_even_asked(
    terminal: int, name: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    assert sharp_widget() is None
    os.set_blocking(terminal, False)
    with pytest.raises(BlockingIOError):
        os.read(terminal, 1)


def test_without_the_extra_nothing_is_missed(terminal: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "textual_image.renderable", None)
    assert sharp_widget() is None


@given(data=st.data())
def test_cells_of_two_shades_show_every_picture_element(data: st.DataObject) -> None:
    """Drawn back by the characters' own shapes."""
    shade = st.integers(0, LEVELS - 1)
    dark, light = sorted((data.draw(shade), data.draw(shade)))
    element = st.sampled_from([dark, light])
    cell = data.draw(st.lists(element, min_size=4, max_size=4))
    (number,) = quadrants(np.array([[cell]])).ravel().tolist()
    bits, shades = divmod(number, (LEVELS + 1) ** 2)
    upper, lower = divmod(shades, LEVELS + 1)
    assert [upper if SHAPES[QUADRANTS[bits]][k] else lower for k in range(4)] == cell


SHAPES = {
    " ": (0, 0, 0, 0), "▘": (1, 0, 0, 0), "▝": (0, 1, 0, 0), "▀": (1, 1, 0, 0), "▖": (0, 0, 1, 0),
    "▌": (1, 0, 1, 0), "▞": (0, 1, 1, 0), "▛": (1, 1, 1, 0), "▗": (0, 0, 0, 1), "▚": (1, 0, 0, 1),
    "▐": (0, 1, 0, 1), "▜": (1, 1, 0, 1), "▄": (0, 0, 1, 1), "▙": (1, 0, 1, 1), "▟": (0, 1, 1, 1),
    "█": (1, 1, 1, 1),
}  # fmt: skip
"""Character → upper left, upper right, lower left, lower right, as Unicode names them."""


async def test_the_wanted_view_is_a_line_that_covers_little_of_the_picture(link: FakeLink) -> None:
    async with app_on(link).run_test(size=(120, 36)) as pilot:
        preview = pilot.app.screen.query_one(PreviewPane)
        await until(pilot, lambda: preview._image is not None)
        preview.wanted = ((0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8))
        segments = [part for y in range(preview.size.height) for part in preview.render_line(y)]
        lined = [part for part in segments if part.style and part.style.color == YELLOW]
        assert len(lined) > 10
        assert "█" not in "".join(part.text for part in lined)


@pytest.mark.parametrize(
    ("theme", "terminal_name", "marks"),
    [
        ("terminal", "linux", "░▒▓█"),
        ("station-dark", "linux", "▀▄█"),
        ("station-dark", "xterm-256color", QUADRANTS),
    ],
)
async def test_the_picture_needs_no_more_than_the_terminal_draws(
    link: FakeLink, theme: str, terminal_name: str, marks: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TEXTUAL_THEME", theme)
    monkeypatch.setenv("TERM", terminal_name)
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        preview = pilot.app.screen.query_one(PreviewPane)
        await until(pilot, lambda: preview._image is not None)
        strips = [preview.render_line(y) for y in range(preview.size.height)]
        text = "".join(strip.text for strip in strips)
        assert set(text) - {" ", "+"} <= set(marks)
        assert "+" in text
        if theme == "terminal":  # light is light on a white terminal too
            shades = [s.style for strip in strips for s in strip if set(s.text) & set(marks)]
            assert {style.bgcolor.name for style in shades if style and style.bgcolor} == {"black"}


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
        link.show(with_robot(idle(), speed_m_s=0.1))
        await until(pilot, lambda: updates)
        await pilot.pause(0.3)
        assert "LayoutUpdate" not in updates
