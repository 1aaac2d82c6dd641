"""Capture by hand on the screen: the wanted outline in the picture, one key to take a view back, a bell."""

from __future__ import annotations

import msgspec
from textual.widgets._footer import FooterKey

from station.cell.status import (
    DetectionStatus,
    EstimateStatus,
    GuidanceStatus,
    PoseStatus,
    StationState,
    StationStatus,
)
from station.protocol import verbs
from station.tui.app import StationApp
from station.tui.task import Known, next_action
from station.tui.widgets.preview import YELLOW, PreviewPane
from tests.tui.conftest import CELL, FakeLink, app_on, idle, in_session, until, with_robot

OUTLINE = ((0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8))


def by_hand(views: int, **guidance: object) -> StationStatus:
    poses = tuple(PoseStatus(k, f"hand-{k + 1:02d}", "done") for k in range(views))
    status = msgspec.structs.replace(
        idle(StationState.FREE_DRIVE),
        detection=DetectionStatus(found=True),
        guidance=GuidanceStatus(outline=OUTLINE, words="Closer", **guidance),
    )
    return in_session(status, poses=poses, captured=views)


def outlined(pane: PreviewPane) -> int:
    """How many cells show the wanted view's outline."""
    parts = [part for row in range(pane.size.height) for part in pane.render_line(row)]
    return sum(len(part.text) for part in parts if part.style is not None and part.style.color == YELLOW)


def footer(app: StationApp) -> dict[str, str]:
    return {shown.key: shown.description for shown in app.screen.query(FooterKey)}


async def test_the_wanted_view_is_drawn_a_view_sounds_and_is_taken_back(link: FakeLink) -> None:
    link.show(in_session(idle(), name=""))
    app = app_on(link)
    bells: list[int] = []
    app.bell = lambda: bells.append(1)
    async with app.run_test(size=(120, 36)) as pilot:
        await until(pilot, lambda: app.known.live is not None)
        await until(pilot, lambda: footer(app).get("f3") == "By hand")
        await pilot.press("f3")
        await until(pilot, lambda: verbs.Freedrive(True) in link.asked)
        await until(pilot, lambda: app.current_mode == "capture")  # where the wanted view is drawn
        link.show(by_hand(2))
        await until(pilot, lambda: footer(app).get("f3") == "End by hand")
        pane = app.screen.query_one(PreviewPane)
        await until(pilot, lambda: outlined(pane) > 20)
        assert not bells, "these views were taken before this screen saw the session"
        link.show(by_hand(3))
        await until(pilot, lambda: bool(bells))
        await pilot.press("backspace")
        await until(pilot, lambda: verbs.Skip(2) in link.asked)
        link.show(msgspec.structs.replace(by_hand(3), state=StationState.SETTLING))
        await until(pilot, lambda: app.known.shown.state is StationState.SETTLING)
        await until(pilot, lambda: footer(app).get("f6") and footer(app).get("f3") == "End by hand")
        await pilot.press("f3")  # ends it after the view that is being taken
        await until(pilot, lambda: verbs.Pause() in link.asked)
        link.show(msgspec.structs.replace(by_hand(3), state=StationState.STOPPED))
        await until(pilot, lambda: "f8" in footer(app) and "f3" not in footer(app))
        link.show(idle())
        await until(pilot, lambda: not outlined(pane))


def test_next_is_the_way_until_it_is_enough() -> None:
    assert next_action(Known(by_hand(3))).label == "Closer"
    moved = next_action(Known(by_hand(6, cause="moved", warning="The board moved.")))
    assert moved.look and moved.why == "The board moved."
    assert next_action(Known(by_hand(12, enough=True))).key == "F7"
    beyond = EstimateStatus(12, predicted_error_mm=1.9, floor_mm=1.8, with_more_views_mm=1.87)
    noisy = msgspec.structs.replace(by_hand(12, enough=True), estimate=beyond)
    finish = next_action(Known(noisy, configuration=CELL))
    assert finish.key == "F7" and "1.8 mm" in finish.why and "1 mm" in finish.why
    check = next_action(Known(in_session(noisy, check=True), configuration=CELL))
    assert "1.8 mm" not in check.why, "a drift check has no goal"
    silent = msgspec.structs.replace(by_hand(12), state=StationState.DISCONNECTED, guidance=GuidanceStatus())
    silent = with_robot(silent, by_hand=True)
    assert next_action(Known(silent)).on("capture").key == "1"
    assert next_action(Known(in_session(silent, recording="session.mcap", captured=12))).key == "F9", (
        "it needs no arm"
    )
