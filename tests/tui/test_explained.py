"""Result: Enter on a check, or on the evidence, says what it means and what to do."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from textual.containers import VerticalScroll
from textual.pilot import Pilot
from textual.widgets import DataTable, Static

from calibrate.files.calibration import Calibration, write_calibration
from calibrate.pipeline.gates import ADVICE, GateLimits
from calibrate.results import Gate
from calibrate.words import words_in, words_of_gates
from station.protocol.results import Installed, Result
from station.tui.help import Explained
from station.tui.result import check_rows, evidence_sections
from tests.tui.conftest import FakeLink, opened, text_of, until
from tests.tui.test_install import GOOD, OFF

GATES = tuple(msgspec.structs.asdict(GateLimits(**ADVICE)))


def with_every_gate() -> Calibration:
    gates = [
        Gate.measured(name, words_of_gates()[name].title, 1.0, "≤", 2.0, "", "Do it.")
        for name in GATES
        if name in words_of_gates()
    ]
    quality = msgspec.structs.replace(GOOD.quality, gates=gates)
    return msgspec.structs.replace(GOOD, quality=quality, verification=[OFF])


@pytest.mark.parametrize("gate", GATES)
def test_every_gate_has_its_word(gate: str) -> None:
    """Whoever adds a gate adds its word to calibrate/words.toml: title, meaning, and what to do."""
    word = words_of_gates()[gate]
    assert word.meaning and word.bad


def test_no_word_is_of_a_gate_that_there_is_not() -> None:
    assert set(words_of_gates()) == set(GATES)


async def on_result(pilot: Pilot[None], folder: Path, calibration: Calibration) -> None:
    path = folder / "sessions" / "s-1" / "calibration.yaml"
    path.parent.mkdir(parents=True)
    write_calibration(calibration, path)
    pilot.app.link.client.root = folder
    pilot.app.result_session = "s-1"
    await pilot.press("4")
    await until(pilot, lambda: "PASS" in text_of(pilot.app, "#verdict"))


async def test_every_title_on_result_is_a_word(link: FakeLink, tmp_path: Path) -> None:
    """Titles of boxes, columns, sections and checks."""
    made = with_every_gate()
    async with opened(link, size=(120, 36)) as pilot:
        await on_result(pilot, tmp_path, made)
        shown = pilot.app.screen.query_one("#result").walk_children()
        titles = [str(widget.border_title) for widget in shown if getattr(widget, "border_title", "")]
        for table in pilot.app.screen.query(DataTable):
            titles += [str(column.label) for column in table.columns.values() if str(column.label)]
    result = Result("", made, Installed(GOOD))
    titles += evidence_sections(result, made)
    titles += [cells[0].plain for cells, _, _ in check_rows(result, made)]
    assert len(titles) > len(GATES)
    assert [title for title in titles if not words_in(title)] == []


async def test_enter_on_a_check_says_what_it_is_and_what_to_do(link: FakeLink, tmp_path: Path) -> None:
    async with opened(link, size=(80, 24)) as pilot:
        made = with_every_gate()
        await on_result(pilot, tmp_path, made)
        rows = check_rows(Result("", made), made)
        await until(pilot, lambda: pilot.app.screen.query_one(DataTable).row_count == len(rows))
        await pilot.press("home")
        for _, text, word in rows:
            await pilot.press("enter")
            await until(pilot, lambda: isinstance(pilot.app.screen, Explained))
            await until(pilot, lambda: pilot.app.screen.query(Static))
            told = "\n".join(
                str(part.render()) for part in pilot.app.screen.query_one("#explained-text").query(Static)
            )
            assert word.plain_meaning in told and word.bad in told and text in told
            await pilot.press("enter")
            await until(pilot, lambda: not isinstance(pilot.app.screen, Explained))
            await pilot.press("down")


async def test_enter_on_the_evidence_explains_its_words(link: FakeLink, tmp_path: Path) -> None:
    async with opened(link, size=(120, 36)) as pilot:
        await on_result(pilot, tmp_path, GOOD)
        pilot.app.screen.query_one("#evidence-box", VerticalScroll).focus()
        await pilot.press("enter")
        await until(pilot, lambda: isinstance(pilot.app.screen, Explained))
        told = "\n".join(str(part.render()) for part in pilot.app.screen.query(".explained-word"))
        for term in ("camera pose", "roll, pitch, yaw", "1σ", "placed-point error"):
            assert term in told


def test_a_word_is_found_whole_and_in_any_case() -> None:
    assert [word.term for word in words_in("Shift: 1σ of the HASH")] == ["hash", "1σ"]
    assert words_in("rehash") == ()


async def test_only_the_table_that_the_keys_work_on_marks_a_row(link: FakeLink, tmp_path: Path) -> None:
    def marking() -> list[str]:
        return [str(table.id) for table in pilot.app.screen.query(DataTable) if table.show_cursor]

    async with opened(link, size=(120, 36)) as pilot:
        await on_result(pilot, tmp_path, GOOD)
        await until(pilot, lambda: marking() == ["checks"])
        await pilot.press("v")
        await until(pilot, lambda: marking() == ["views"])
        pilot.app.screen.query_one("#evidence-box").focus()
        await until(pilot, lambda: marking() == [])
