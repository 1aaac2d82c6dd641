"""A terminal that answers no more: the arm must not go on for a screen at which nobody can be."""

from __future__ import annotations

import pytest
from textual import events

from station.cell.status import StationState
from station.protocol import verbs
from station.tui import daemon_link
from tests.tui.conftest import FakeLink, app_on, commanded, said, text_of, until

LOST = verbs.Release(silent=True)


@pytest.mark.parametrize(
    ("state", "holder", "answered", "lost"),
    [
        (StationState.MOVING, 7, True, True),
        (StationState.MOVING, 7, False, False),  # one that never answers cannot be missed
        (StationState.MOVING, 8, True, False),  # somebody else commands
        (StationState.PAUSED, 7, True, False),  # nothing moves
    ],
)
async def test_who_commands_a_moving_arm_is_asked_for(
    link: FakeLink,
    monkeypatch: pytest.MonkeyPatch,
    state: StationState,
    holder: int,
    answered: bool,
    lost: bool,
) -> None:
    monkeypatch.setattr(daemon_link, "ASK_S", 60.0)  # only the test asks
    asked = []
    monkeypatch.setattr(daemon_link.TerminalWatch, "ask", lambda seen: asked.append(seen))
    link.show(commanded(state, holder))
    app = app_on(link)
    async with app.run_test(size=(80, 24), notifications=True) as pilot:
        await until(pilot, lambda: "SIMULATED" in text_of(app, "#bar"))
        for _ in range(2 * answered):  # an answer begins the count again
            app.post_message(events.CursorPosition(0, 0))
            await until(pilot, lambda: app.terminal_watch.unanswered == 0)
            for _ in range(daemon_link.UNANSWERED):
                await app.terminal_watch.look()
            assert LOST not in link.asked
        for _ in range(2 * daemon_link.UNANSWERED):
            await app.terminal_watch.look()
            await pilot.pause()
        assert (LOST in link.asked) is lost
        assert ("control released" in said(pilot)) is lost
        assert len(asked) >= daemon_link.UNANSWERED or not lost
