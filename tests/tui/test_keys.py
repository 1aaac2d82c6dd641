"""Keys: what each sends, and that nothing moves without the question being answered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from station.cell.errors import RefusedError
from station.cell.status import StationState
from station.protocol import verbs
from station.tui.dialogs import Confirm, ConfirmFinish, ConfirmMotion, JobScreen, Reason
from station.tui.frame import Question
from station.tui.help import action_entries
from tests.tui.conftest import (
    SUMMARY,
    FakeLink,
    app_on,
    commanded,
    idle,
    in_session,
    opened,
    said,
    text_of,
    until,
)


async def test_run_asks_and_only_yes_carries_the_token(link: FakeLink) -> None:
    """Both easy answers are no; STOP works in the question, and no notice hides how to answer."""
    link.answers["prepare"] = msgspec.structs.replace(SUMMARY, warnings=("0.61 → 0.52 mm " * 6,))
    async with opened(link, (60, 20), notifications=True) as pilot:
        pilot.app.notify("no session is open", timeout=3600)
        for stops, answer in enumerate(("escape", "enter", ""), start=1):
            await pilot.press("2", "f5")
            await until(pilot, lambda: pilot.app.screen.query("#confirm-body"))
            assert isinstance(pilot.app.screen, ConfirmMotion)
            await until(pilot, lambda: not pilot.app._notifications)
            await pilot.press("f12")
            await until(pilot, lambda stops=stops: link.verbs.count("stop") == stops)
            assert "go" not in link.verbs
            if answer:
                await pilot.press(answer)
                await until(pilot, lambda: not isinstance(pilot.app.screen, ConfirmMotion))
        facts = text_of(pilot.app, "#confirm-body")
        assert "84 mm and 22° to pose 1" in facts and "0.22 m/s" in facts
        warning = next(i for i, line in enumerate(facts.splitlines()) if line.startswith("WARNING"))
        assert facts.splitlines()[warning + 1].startswith(" " * 10 + "0")  # a long fact goes on below itself
        for ends in (idle(StationState.STOPPED), None):
            link.show(ends)
            await until(pilot, lambda: not isinstance(pilot.app.screen, ConfirmMotion))
            link.show(idle())
            await until(pilot, lambda: "IDLE" in text_of(pilot.app, "#bar"))
            await pilot.press("f5")
            await until(pilot, lambda: pilot.app.screen.query("#yes"))
        await until(pilot, lambda: pilot.app.screen.query_one("#yes").region)
        await pilot.press("f8")  # as STOP's, it works in a question, and leaves it answerable
        await until(pilot, lambda: "acknowledge" in link.verbs)
        offered = {entry.action for entry in action_entries(pilot.app, pilot.app.screen)}
        assert offered == {"stop", "acknowledge"}, "others would take the question away"
        await pilot.click("#yes")
        await until(pilot, lambda: verbs.Go("t-1", SUMMARY.approval_sha256) in link.asked)
        await until(pilot, lambda: pilot.app.current_mode == "capture")  # where the work is watched


@pytest.mark.parametrize("why", ["STOP", "expired"])
async def test_a_question_below_help_closes_once_help_is_closed(link: FakeLink, why: str) -> None:
    async with opened(link, notifications=True) as pilot:
        await pilot.press("f5")
        await until(pilot, lambda: pilot.app.screen.query("#yes"))
        question = pilot.app.screen
        await pilot.press("f1")
        await until(pilot, lambda: pilot.app.screen is not question)
        for reason in ("STOP by ben", "STOP by anna"):  # each is drawn
            link.show(idle(StationState.STOPPED, reason) if why == "STOP" else idle(reason=reason))
            await until(pilot, lambda reason=reason: question.known.shown.reason == reason)
            question._until_s = 0.0 if why == "expired" else question._until_s
            question._count_down()
            await pilot.pause()
        assert pilot.app.screen is not question and question in pilot.app.screen_stack
        await pilot.press("escape")
        await until(pilot, lambda: question not in pilot.app.screen_stack)
        assert "go" not in link.verbs


async def test_a_key_sends_its_wish_at_once_and_a_refusal_is_said(link: FakeLink) -> None:
    wishes = {"f6": ["pause"], "f8": ["acknowledge"], "f3": ["free_drive"], "f2": ["record"], "f12": ["stop"]}
    link.refuse["prepare"] = RefusedError("control-held", holder="anna on tty1")
    async with opened(link, notifications=True) as pilot:
        for key, wish in wishes.items():
            link.asked.clear()
            await pilot.press(key)
            await until(pilot, lambda wish=wish: link.verbs == wish)
        link.asked.clear()
        await pilot.press("f5")
        await until(pilot, lambda: "anna on tty1" in said(pilot))
        assert link.verbs == ["prepare"], "nothing moves"


async def test_finish_asks_and_then_seals(link: FakeLink) -> None:
    link.show(idle(StationState.PAUSED))
    async with opened(link) as pilot:
        await pilot.press("f7")
        await until(pilot, lambda: isinstance(pilot.app.screen, Confirm))
        assert link.verbs == []
        await until(pilot, lambda: pilot.app.screen.query_one("#yes").region)
        await pilot.click("#yes")
        await until(pilot, lambda: link.verbs == ["finish"])


async def test_the_plan_screen_asks_for_changes_of_the_highlighted_pose(link: FakeLink) -> None:
    requests: dict[str, verbs.Verb[Any]] = {
        "r": verbs.Retake(2),
        "s": verbs.Skip(2),
        "n": verbs.MakePlan(25, seed=1),
    }
    async with opened(link, size=(120, 34)) as pilot:
        await pilot.press("2")
        await pilot.pause()
        for key, request in requests.items():
            await pilot.press("home", "down", "down", key)
            await until(pilot, lambda request=request: request in link.asked)


def kinds_of(kind: type[Question[Any]]) -> set[type[Question[Any]]]:
    """Every kind of question that the screens may ask."""
    direct = set(kind.__subclasses__())
    return direct.union(*map(kinds_of, direct))


MADE: dict[str, Callable[[], Question[Any]]] = {
    "Confirm": lambda: Confirm("Sure?", "It ends.", yes="End"),
    "ConfirmFinish": ConfirmFinish,
    "ConfirmMotion": lambda: ConfirmMotion(SUMMARY),
    "Reason": lambda: Reason("Why?", "Enter does it."),
}
NOTHING_TO_APPROVE = {"JobScreen", "TouchCorners", "Explained", "Help"}
"""Work that a person began, positions that are read, texts, and help, which has tests of its own."""


async def test_enter_alone_says_yes_to_no_question(link: FakeLink) -> None:
    """Whoever adds a kind of question adds it here."""
    assert {kind.__name__ for kind in kinds_of(Question)} - NOTHING_TO_APPROVE == MADE.keys()
    async with opened(link) as pilot:
        for make in MADE.values():
            answers: list[Any] = []
            question = make()
            await pilot.app.push_screen(question, answers.append)
            await until(pilot, lambda question=question: question.focused is not None)
            await pilot.press("enter")
            await pilot.pause()
            assert not any(answers)
            if not answers:
                await pilot.press("escape")
                await until(pilot, lambda answers=answers: answers)
                assert not any(answers)
        assert link.verbs == []


@pytest.mark.parametrize(
    ("state", "holder", "asks"),
    [(StationState.MOVING, 7, True), (StationState.MOVING, 8, False), (StationState.PAUSED, 7, False)],
)
async def test_only_what_ends_control_of_an_arm_at_work_asks(
    link: FakeLink, state: StationState, holder: int, asks: bool
) -> None:
    async with opened(link) as pilot:
        link.show(shown := commanded(state, holder))
        await until(pilot, lambda: pilot.app.known.status == shown)
        await pilot.app.run_action("quit")
        await until(pilot, lambda: pilot.app._exit or pilot.app.screen.query("#confirm-body"))
        assert pilot.app._exit is not asks and verbs.Release() not in link.asked


async def test_what_a_stop_refused_is_not_said_any_more_after_it(link: FakeLink) -> None:
    """A notice outlives its reason by seconds otherwise."""
    link.show(idle(StationState.STOPPED, "STOP by ann"))
    link.refuse["prepare"] = refused = RefusedError("stop-latched")
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await until(pilot, lambda: "STOPPED" in text_of(pilot.app, "#bar"))
        await pilot.press("f5")
        await until(pilot, lambda: [n.message for n in pilot.app._notifications] == [str(refused)])
        link.refuse["acknowledge"] = RefusedError()
        await pilot.press("f8")
        await until(pilot, lambda: len(pilot.app._notifications) == 2)
        link.refuse.clear()
        await pilot.press("f8")
        await until(pilot, lambda: not pilot.app._notifications)


async def test_a_session_without_poses_to_solve_is_not_solved_and_its_key_names_the_way_out(
    link: FakeLink,
) -> None:
    link.show(in_session(idle(), recording="/r/session.mcap", captured=0))
    async with opened(link, notifications=True) as pilot:
        await pilot.press("f9")
        await until(pilot, lambda: "F5" in said(pilot))
        assert not isinstance(pilot.app.screen, JobScreen)


async def test_the_question_to_finish_counts_the_poses_while_the_arm_goes_on(link: FakeLink) -> None:
    async with opened(link) as pilot:
        for captured in (6, 9):
            link.show(in_session(commanded(StationState.MOVING), captured=captured))
            if captured == 6:
                await until(pilot, lambda: pilot.app.known.works)
                await pilot.press("f7")
            await until(pilot, lambda: pilot.app.screen.query("#confirm-body"))
            count = f"{captured} of 25"
            await until(pilot, lambda count=count: count in text_of(pilot.app, "#confirm-body"))


@pytest.mark.parametrize(("holder", "offered"), [(7, True), (8, False)])
async def test_a_screen_beside_the_one_in_control_offers_no_key_that_is_refused(
    link: FakeLink, holder: int, offered: bool
) -> None:
    link.show(commanded(StationState.PAUSED, holder))
    async with opened(link, size=(120, 36)) as pilot:
        await until(pilot, lambda: "PAUSED" in text_of(pilot.app, "#bar"))
        screen = pilot.app.screen
        assert [screen.does_something(action) for action in ("run", "finish")] == [offered] * 2
        await until(pilot, lambda: ("F5" in text_of(pilot.app, "#next")) is offered)
        assert ("anna on tty1" in text_of(pilot.app, "#next")) is not offered
        await pilot.press("f12")
        await until(pilot, lambda: "stop" in link.verbs)
