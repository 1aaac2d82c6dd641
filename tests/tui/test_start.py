"""What is shown first, what is said when a key can do nothing, and how the screen looks on old terminals."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from textual.widgets import DataTable

from station.cell.status import StationState
from station.protocol.verbs import Check
from station.tui import connect
from station.tui.app import StationApp
from station.tui.capture_screen import CaptureScreen
from station.tui.connect import ConnectScreen
from station.tui.plan_screen import NO_PLAN
from station.tui.themes import chosen_theme
from tests.tui.conftest import FakeLink, app_on, idle, in_session, opened, said, text_of, until

MISSING = [Check("robot", "failed", "no answer", "switch it on")]
THERE = [Check("robot", "ok", "UR10")]


async def test_without_a_robot_the_checklist_comes_first_and_keys_read_it_to_its_end(
    link: FakeLink,
) -> None:
    link.show(idle(StationState.DISCONNECTED))
    link.answers["doctor"] = MISSING * 20
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: isinstance(pilot.app.screen, ConnectScreen))
        await until(pilot, lambda: "switch&#160;it&#160;on" in pilot.app.export_screenshot())
        assert "MISSING" in pilot.app.export_screenshot()
        assert "This&#160;list&#160;refreshes" not in pilot.app.export_screenshot()
        await pilot.press("end")
        await until(pilot, lambda: "This&#160;list&#160;refreshes" in pilot.app.export_screenshot())


async def test_what_was_missing_is_looked_for_on_every_screen(
    link: FakeLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connect, "AGAIN_S", 0.1)
    link.answers["doctor"] = MISSING
    async with opened(link) as pilot:
        await pilot.press("1")
        await until(pilot, lambda: pilot.app.known.missing is not None)
        await pilot.press("3")
        link.answers["doctor"] = THERE
        await until(pilot, lambda: pilot.app.known.missing is None)
        assert isinstance(pilot.app.screen, CaptureScreen)


async def test_a_key_that_can_do_nothing_says_why(link: FakeLink, tmp_path: Path) -> None:
    reasons = [
        ("3", "f7", "no session is running"),
        ("3", "f9", "Nothing is finished yet"),
        ("2", "r", "No plan is loaded"),
        ("4", "i", "There is no result"),
        ("5", "c", "No session is recorded yet"),
    ]
    link.show(in_session(idle(), poses=()))
    link.answers |= {"doctor": THERE}
    link.root = tmp_path
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await pilot.press("1")
        await until(pilot, lambda: "Nothing&#160;is&#160;missing" in pilot.app.export_screenshot())
        for screen, key, words in reasons:
            await pilot.press(screen)
            await pilot.pause()
            pilot.app.clear_notifications()
            await pilot.press(key)
            await until(pilot, lambda w=words: w in said(pilot))
        assert not {"go", "prepare", "finish"} & set(link.verbs)


async def test_an_empty_list_says_how_to_begin_but_not_before_it_is_known(
    link: FakeLink, tmp_path: Path
) -> None:
    link.root, session = tmp_path, tmp_path / "sessions" / "s-0"
    session.mkdir(parents=True)
    async with opened(link) as pilot:
        await pilot.press("5")
        await until(pilot, lambda: pilot.app.screen.query_one(DataTable).row_count == 1)
        hint = pilot.app.screen.query_one("#sessions-none")
        assert not hint.display
        session.rmdir()
        await pilot.press("3", "5")
        await until(pilot, lambda: hint.display)


async def test_the_highlighted_pose_is_told_in_full(link: FakeLink) -> None:
    status = idle()
    poses = list(status.session.poses)
    reason = "no board in the picture: " + "look at the light " * 4
    poses[1] = msgspec.structs.replace(poses[1], state="failed", reason=reason, attempt=2)
    link.show(in_session(status, poses=tuple(poses)))
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await pilot.pause()
        await pilot.press("2", "down", "enter")
        await until(pilot, lambda: reason in said(pilot))
        link.show(in_session(status, poses=()))
        await until(pilot, lambda: text_of(pilot.app, "#plan-facts") == NO_PLAN)


def test_every_key_has_a_tooltip() -> None:
    for owner in (StationApp, *StationApp.MODES.values()):
        for binding in vars(owner).get("BINDINGS", ()):
            assert binding.tooltip, (owner, binding)


def test_a_console_with_16_colours_gets_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TEXTUAL_THEME", raising=False)
    monkeypatch.setenv("TERM", "linux")
    assert chosen_theme() == "terminal"
    monkeypatch.setenv("TERM", "xterm-256color")
    assert chosen_theme() == "station-dark"
    monkeypatch.setenv("TEXTUAL_THEME", "no such theme")
    assert chosen_theme() == "station-dark"
