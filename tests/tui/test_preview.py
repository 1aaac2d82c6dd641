"""The live picture: its signs on every terminal, and that a status repaints only what it changes."""

from __future__ import annotations

from typing import Any

import pytest
from textual._compositor import Compositor

from station.tui.widgets.preview import PreviewPane
from tests.tui.conftest import FakeLink, app_on, idle, opened, until, with_robot


@pytest.mark.parametrize(("theme", "marks"), [("terminal", "░▒▓█"), ("station-dark", "▀")])
async def test_the_picture_needs_no_grey_background_on_a_console(
    link: FakeLink, theme: str, marks: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TEXTUAL_THEME", theme)
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
