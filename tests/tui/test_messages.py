"""Messages that show a path: it stays one line, which can be read and copied."""

from __future__ import annotations

from textual.widgets._toast import Toast

from station.tui.themes import ThemedApp
from tests.tui.conftest import until

PATH = "/home/operator/cells/welding-three/sessions/2026-11-03/calibration/report.html"
ONE_LINE = 3
"""Rows of a message of one line: padding above and below."""


async def test_a_path_that_the_screen_has_room_for_is_shown_whole_on_one_line() -> None:
    async with ThemedApp[None]().run_test(size=(120, 36), notifications=True) as pilot:
        pilot.app.notify(PATH, markup=False)
        await until(pilot, lambda: bool(pilot.app.screen.query(Toast)))
        await pilot.pause()
        toast = pilot.app.screen.query_one(Toast)
        assert str(toast.render()) == PATH
        assert toast.region.height == ONE_LINE


async def test_a_longer_path_is_shortened_in_its_middle() -> None:
    long = f"/home/operator/{'very-long-folder/' * 10}report.html"
    async with ThemedApp[None]().run_test(size=(80, 24), notifications=True) as pilot:
        pilot.app.notify(f"Written: {long} now", markup=False)
        await until(pilot, lambda: bool(pilot.app.screen.query(Toast)))
        await pilot.pause()
        toast = pilot.app.screen.query_one(Toast)
        path = str(toast.render()).split()[1]
        assert "…" in path
        assert long.startswith(path.partition("…")[0])
        assert long.endswith(path.partition("…")[2])
        assert path.endswith("report.html")
        assert toast.region.right <= 80
