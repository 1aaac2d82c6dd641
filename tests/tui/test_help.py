"""Help (F1): every key by its task, every word, and nothing chosen that a person did not choose."""

from __future__ import annotations

import msgspec
import pytest
from textual.binding import Binding
from textual.pilot import Pilot
from textual.widgets import Input, OptionList

from calibrate.words import word_of, words
from station.cell.status import StationState
from station.protocol import verbs
from station.tui.app import SCREENS, StationApp
from station.tui.help import MORE, TASKS, Entry, Help, action_entries, entries_with, word_entries, word_text
from tests.tui.conftest import FakeLink, app_on, idle, opened, said, text_of, until


async def open_help(pilot: Pilot[None], typed: str = "") -> Help:
    await pilot.press("f1")
    await until(pilot, lambda: isinstance(pilot.app.screen, Help) and pilot.app.screen.query(Input))
    help_screen = pilot.app.screen
    assert isinstance(help_screen, Help)
    help_screen.query_one(Input).value = typed
    await pilot.pause()
    return help_screen


def all_entries(app: StationApp) -> list[Entry]:
    return [*action_entries(app, app.screen), *word_entries()]


async def test_help_is_ordered_by_task_and_has_every_key(link: FakeLink) -> None:
    """Whoever adds a key names its task in `help.TASKS`."""
    async with opened(link) as pilot:
        entries = action_entries(pilot.app, pilot.app.screen)
    headings = list(dict.fromkeys(entry.heading for entry in entries))
    assert headings == list(TASKS) and MORE not in headings
    explained = {
        (screen.MODE if screen is not StationApp else "", binding.action)
        for screen in (StationApp, *SCREENS)
        for binding in screen.BINDINGS
        if isinstance(binding, Binding) and binding.tooltip
    }
    assert explained < {(entry.mode, entry.action) for entry in entries}


@pytest.mark.parametrize("typed", ["", "acknowledge", "undo", "run", "skip", "finish", "quit"])
async def test_enter_alone_does_nothing_that_unlatches_moves_deletes_or_ends(
    link: FakeLink, typed: str
) -> None:
    """F12, F1, Enter once left STOP: what stands first is chosen by Enter only where it is harmless."""
    link.show(idle(StationState.STOPPED))
    async with opened(link) as pilot:
        await until(pilot, lambda: "STOPPED" in text_of(pilot.app, "#bar"))
        before = list(link.verbs)
        await open_help(pilot, typed)
        await pilot.press("enter")
        await pilot.pause()
        assert link.verbs == before and not pilot.app._exit


async def test_an_action_is_found_by_typing_and_done_by_choosing_it(link: FakeLink) -> None:
    async with opened(link) as pilot:
        await open_help(pilot, "f6")
        await pilot.press("down", "enter")
        await until(pilot, lambda: verbs.Pause() in link.asked)


async def test_an_action_of_another_screen_is_led_to_and_not_done(link: FakeLink) -> None:
    async with opened(link, notifications=True) as pilot:
        await open_help(pilot, "skip")
        await pilot.press("down", "enter")
        await until(pilot, lambda: pilot.app.current_mode == "plan" and said(pilot))
        assert "skip" not in link.verbs
        await open_help(pilot, "skip")
        await pilot.press("down", "enter")
        await until(pilot, lambda: verbs.Skip(0) in link.asked)


async def test_stop_works_while_help_is_open_and_help_opens_over_a_question(link: FakeLink) -> None:
    async with opened(link) as pilot:
        await pilot.press("f5")
        await until(pilot, lambda: pilot.app.screen.query("#yes"))
        question = pilot.app.screen
        help_screen = await open_help(pilot, "hash")
        assert word_of("hash").plain_meaning in text_of(pilot.app, "#help-text")
        await pilot.press("f12")
        await until(pilot, lambda: "stop" in link.verbs)
        assert help_screen is pilot.app.screen
        await pilot.press("escape")
        await until(pilot, lambda: pilot.app.screen is question)


async def test_the_glossary_holds_what_was_not_understood(link: FakeLink) -> None:
    """By the names that the screen once had, too."""
    once = ["hash", "gate", "mean view weight", "rotation diversity", "held-out error", "kinematics"]
    once += ["shift by the stated board", "roll", "p-value", "pts", "pid"]
    async with app_on(link).run_test():
        for typed in once:
            found = entries_with(word_entries(), typed)
            assert found and found[0].names(typed), typed


async def test_every_word_is_listed_and_told_whole(link: FakeLink) -> None:
    async with opened(link, size=(80, 24)) as pilot:
        screen = await open_help(pilot, "gate")
        await until(pilot, lambda: "A named condition" in text_of(pilot.app, "#help-text"))
        assert [entry.word for entry in all_entries(pilot.app) if entry.word] == list(words())
        screen.query_one(Input).value = "no such thing"
        await until(pilot, lambda: not screen.query_one(OptionList).option_count)
    for word in words():
        told = word_text(word).plain
        assert word.plain_meaning in told and word.bad in told
        assert word in [entry.word for entry in entries_with(word_entries(), word.term)]


def test_a_word_has_one_entry_and_no_word_is_used_and_retired() -> None:
    terms = [word.term.lower() for word in words()]
    assert len(set(terms)) == len(terms)
    shown = {form.lower() for word in words() for form in word.shown}
    assert shown & set(terms) == set(), "two entries for one form"
    assert all(word.meaning.endswith(".") and word.meaning[0].isupper() for word in words())
    assert all(msgspec.structs.asdict(word)["group"] for word in words())
