"""A daemon that hangs keeps its socket open and says nothing: the screen must not look alive."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest
from textual.widgets import DataTable

from station.cell.status import Event, StationState
from station.protocol.client import Client, DaemonGoneError
from station.tui import daemon_link
from station.tui.capture_screen import CaptureScreen
from station.tui.daemon_link import STOP_UNHEARD
from station.tui.widgets.preview import OLD, PreviewPane
from tests.tui.conftest import CELL, FakeLink, app_on, idle, in_session, opened, said, text_of, until


@pytest.fixture(autouse=True)
def short_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(daemon_link, "LISTEN_S", 0.2)
    monkeypatch.setattr(daemon_link, "SILENT_S", 0.2)


async def test_a_daemon_that_does_not_answer_is_announced_and_what_it_said_is_old(link: FakeLink) -> None:
    link.show(idle(StationState.MOVING))
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: "MOVING" in text_of(pilot.app, "#bar"))
        preview = pilot.app.screen.query_one(PreviewPane)
        await until(pilot, lambda: preview._image is not None)
        link.silent.set()
        await until(pilot, lambda: "NO ANSWER" in text_of(pilot.app, "#bar"))
        await pilot.pause()
        assert "MOVING" not in text_of(pilot.app, "#bar")
        assert "EMERGENCY STOP" in text_of(pilot.app, "#next")
        assert str(pilot.app.screen.query_one("#progress").border_title).endswith(": OLD")
        assert OLD in preview.render_line(preview.size.height // 2).text
        await pilot.press("2")  # every screen says it
        await until(pilot, lambda: "NO ANSWER" in text_of(pilot.app, "#bar"))
        await pilot.press("3")
        link.silent.clear()
        await until(pilot, lambda: "MOVING" in text_of(pilot.app, "#bar"))
        assert "F6" in text_of(pilot.app, "#next")
        assert OLD not in preview.render_line(preview.size.height // 2).text


async def test_meanwhile_only_stop_is_sent_and_the_emergency_stop_is_named(link: FakeLink) -> None:
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await pilot.pause()
        link.silent.set()
        await until(pilot, lambda: "NO ANSWER" in text_of(pilot.app, "#bar"))
        await pilot.press("f5", "f6")
        await pilot.pause()
        assert link.verbs == []
        await pilot.press("f12")
        await pilot.pause()
        assert link.verbs == ["stop"]
        assert STOP_UNHEARD in said(pilot)
        link.silent.clear()


async def test_without_a_daemon_what_it_said_last_stays_and_is_marked_old(link: FakeLink) -> None:
    """Also on a screen that was away meanwhile: not what it had shown itself when it was left."""
    warning = Event(1, "warning", "pose 3 did not come to rest")
    async with opened(link, size=(160, 48)) as pilot:
        await pilot.press("2")
        await until(pilot, lambda: pilot.app.screen.query(DataTable))
        table = pilot.app.screen.query_one(DataTable)
        await until(pilot, lambda: table.row_count == 25)
        moving = in_session(idle(StationState.MOVING), current=7)
        link.show(msgspec.structs.replace(moving, events=(warning,)))
        await until(pilot, lambda: "MOVING" in text_of(pilot.app, "#bar"))
        link.show(None)
        await until(pilot, lambda: "NO DAEMON" in text_of(pilot.app, "#bar"))
        assert "The daemon ended" in text_of(pilot.app, "#next")
        assert table.row_count == 25
        await pilot.press("3")
        await until(pilot, lambda: "p08" in text_of(pilot.app, "#progress"))
        assert "NO DAEMON" in text_of(pilot.app, "#bar")
        assert str(pilot.app.screen.query_one("#progress").border_title) == "Pose 8 of 25: OLD"
        link.config = msgspec.structs.replace(CELL, name="another cell")  # the next daemon's
        link.show(idle())
        await until(pilot, lambda: pilot.app.known.configuration == link.config)


@pytest.mark.parametrize(("heard", "told"), [(True, "without a connection"), (False, "EMERGENCY STOP")])
async def test_without_a_connection_stop_is_sent_all_the_same(heard: bool, told: str) -> None:
    class Nobody(FakeLink):
        async def open(self) -> Client:
            raise DaemonGoneError("16 clients of this user are connected already")

        def send_stop(self) -> str:
            sent.append(True)
            return "" if heard else "nobody heard it: EMERGENCY STOP"

    sent: list[bool] = []
    async with app_on(Nobody()).run_test(size=(80, 24), notifications=True) as pilot:
        await pilot.press("f12")
        await until(pilot, lambda: told in said(pilot))
    assert sent


async def test_news_that_arrive_while_the_screen_closes_do_no_harm(
    link: FakeLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = app_on(link)
    heard: list[bool] = []

    def on_unmount(screen: CaptureScreen) -> None:
        app.known = replace(app.known, silent_s=5.0)
        heard.append(True)

    monkeypatch.setattr(CaptureScreen, "on_unmount", on_unmount, raising=False)
    async with app.run_test() as pilot:
        await until(pilot, lambda: isinstance(app.screen, CaptureScreen) and app.screen.is_mounted)
    assert heard
