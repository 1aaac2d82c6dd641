"""Keys: what each sends, and that nothing moves without the question being answered."""

from __future__ import annotations

import pytest
from textual.widgets import Static

from station.errors import RefusedError
from station.status import StationState
from station.tui.app import StationApp
from station.tui.confirm import ConfirmGo
from tests.tui.conftest import FakeLink, idle


def app_on(link: FakeLink) -> StationApp:
    async def connect() -> FakeLink:
        return link

    return StationApp(connect)


def text_of(app: StationApp, selector: str) -> str:
    return str(app.screen.query_one(selector, Static).render())


async def test_run_asks_first_and_go_carries_the_token(link: FakeLink) -> None:
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await pilot.pause()
        await pilot.press("f5")
        await pilot.pause()
        assert isinstance(pilot.app.screen, ConfirmGo)
        assert "go" not in link.verbs
        body = str(pilot.app.screen.query_one("#confirm-body", Static).render())
        assert "84 mm and 22° to pose 1" in body
        assert "0.22 m/s" in body
        await pilot.click("#yes")
        await pilot.pause()
        assert link.asked[-1] == ("go", {"token": "t-1"}) or ("go", {"token": "t-1"}) in link.asked


@pytest.mark.parametrize("answer", ["escape", "enter"])
async def test_the_harmless_answer_is_the_easy_one(link: FakeLink, answer: str) -> None:
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await pilot.pause()
        await pilot.press("f5")
        await pilot.pause()
        await pilot.press(answer)
        await pilot.pause()
        assert "go" not in link.verbs


async def test_stop_works_inside_the_question_too(link: FakeLink) -> None:
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await pilot.pause()
        await pilot.press("f5")
        await pilot.pause()
        await pilot.press("f12")
        await pilot.pause()
        assert "stop" in link.verbs


async def test_a_refusal_is_said_and_nothing_moves(link: FakeLink) -> None:
    link.refuse["lease"] = RefusedError("held by anna on tty1")
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await pilot.pause()
        await pilot.press("f5")
        await pilot.pause()
        assert link.verbs == ["lease"]
        assert any("held by anna" in n.message for n in pilot.app._notifications)


async def test_the_bar_says_state_robot_and_stop_key(link: FakeLink) -> None:
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await pilot.pause()
        bar = text_of(pilot.app, "#bar")
        for word in ("SIMULATED", "UR10", "NORMAL", "REMOTE", "0/25", "F12=STOP"):
            assert word in bar
        link.show(idle(StationState.STOPPED, "protective stop C157 at pose 18; inspect, then F8"))
        await pilot.pause()
        assert "STOPPED" in text_of(pilot.app, "#bar")
        assert "protective stop C157" in text_of(pilot.app, "#reason")


async def test_a_dead_daemon_is_said(link: FakeLink) -> None:
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await pilot.pause()
        link.show(None)
        await pilot.pause()
        assert "no connection to the daemon" in text_of(pilot.app, "#bar")
