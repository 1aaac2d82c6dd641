"""Views as a table on Result: the worst first, excluded and solved again by few keys, undone by one."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from textual.pilot import Pilot
from textual.widgets import DataTable

from calibrate.files.calibration import Calibration, read_calibration, write_calibration
from calibrate.pipeline.job import solve_recording
from calibrate.results import AllViews, Excluded, HoldoutScore, RejectedView, ViewQuality, Views, ViewWeight
from station.cell.session_folder import CALIBRATION_FILE, solve_arguments
from station.protocol.results import Result
from station.tui.help import Explained
from station.tui.result import ResultScreen, evidence, verdict_lines
from station.tui.task import Known, next_action
from station.tui.view_table import view_cells, view_rows
from tests.calibrate.sessions import Scene, write_session
from tests.tui.conftest import FakeLink, idle, in_session, opened, said, text_of, until
from tests.tui.test_install import GOOD

USED = [ViewQuality(0, 0.1, 0.1, 0.01), ViewQuality(1, 0.1, 0.9, 0.01), ViewQuality(2, 0.2, 0.1, 0.01)]
REJECTED = [
    RejectedView(3, "p4", "it contradicts others", "wrong-pose"),
    RejectedView(4, "p5", "excluded by a person (--without)", "by-hand"),
    RejectedView(5, "p6", "no board", "corners"),
]
HELD_OUT = HoldoutScore(0.001, 0.001, [0.001], [0.001], [(0, 1)], 1)
OF_ALL = AllViews(
    error_mm=0.5,
    holdout_m=0.002,
    shift=(0.001, 0, 0, 0, 0, 0),
    views=[ViewQuality(4, 3.0, 2.0, 0.1)],
    weights=[ViewWeight(4, 0.3)],
)


def small(**changes: object) -> Calibration:
    """Three views used, two rejected, one excluded by anna."""
    weights = [ViewWeight(0, 1.0), ViewWeight(1, 1.0), ViewWeight(2, 1.0), ViewWeight(3, 0.0)]
    return msgspec.structs.replace(
        GOOD,
        views=Views(used=[0, 1, 2], rejected=REJECTED, weights=weights),
        quality=msgspec.structs.replace(GOOD.quality, views=USED, predicted_error_mm=0.4, holdout=HELD_OUT),
        excluded=Excluded([4], "anna", OF_ALL),
        **changes,
    )


def test_excluded_views_come_first_then_rejected_ones_then_the_worst() -> None:
    rows = view_rows(small())
    assert [row.index for row in rows] == [4, 3, 5, 1, 2, 0]
    assert rows[0].reason == "excluded by anna" and rows[0].quality.robot_mm == 2.0
    assert not rows[2].can_be_used


def test_a_row_tells_residuals_weight_and_reason() -> None:
    told = {row.index: " ".join(cell.plain for cell in view_cells(row, {4})) for row in view_rows(small())}
    assert "0.900 mm" in told[1] and "0.010°" in told[1] and "100 %" in told[1] and "used" in told[1]
    assert "it contradicts" in told[3] and "  0 %" in told[3]
    assert "excluded by anna" in told[4] and "3.000 px" in told[4] and "30 %" in told[4]


def test_a_mark_is_what_the_next_solve_does() -> None:
    states = {row.index: view_cells(row, {1})[-1].plain for row in view_rows(small())}
    assert "exclude" in states[1] and "take it again" in states[4] and "used" in states[0]


def test_the_first_line_counts_what_a_person_excluded_and_all_views_stand_beside() -> None:
    result = Result("", small())
    head, beside, *_ = verdict_lines(result).plain.splitlines()
    assert "PASS, 1 view excluded by a person" in head
    assert "1 mm, of all views 2 mm" in beside
    shown = evidence(result, small()).plain
    assert "Excluded by anna: pose 5." in shown
    assert "of all views 0.5 mm" in shown


def test_the_next_action_says_what_speaks_against_it_and_that_a_reason_is_asked() -> None:
    objection = "A person excluded 6 of 25 views, more than a fifth."
    status = in_session(idle(), poses=(), recording="r")
    action = next_action(Known(status=status, result=Result("", small(), objections=(objection,))))
    assert objection in action.why and not action.key


def test_the_pose_numbers_of_the_command_count_from_one() -> None:
    assert solve_arguments("r", "f", {6, 2})[-2:] == ("--without", "3,7")
    assert "--without" not in solve_arguments("r", "f")


@pytest.fixture(scope="module")
def solved_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of eight rendered views, solved."""
    folder = tmp_path_factory.mktemp("root") / "sessions" / "s-1"
    folder.mkdir(parents=True)
    recording = write_session(folder / "session.mcap", Scene(views=8), known_lens=True)
    write_calibration(solve_recording(recording).calibration, folder / CALIBRATION_FILE)
    return folder / CALIBRATION_FILE


def verdict(pilot: Pilot[None]) -> str:
    """The verdict on Result; empty while a window is over it."""
    return text_of(pilot.app, "#verdict") if isinstance(pilot.app.screen, ResultScreen) else ""


async def test_a_view_is_excluded_and_compared_by_four_keys_and_taken_again_by_one(
    link: FakeLink, solved_session: Path
) -> None:
    link.root = solved_session.parents[2]
    before = read_calibration(solved_session)
    worst = view_rows(before)[0].index
    async with opened(link, size=(120, 36)) as pilot:
        pilot.app.result_session = "s-1"
        await until(pilot, lambda: pilot.app.known.result and pilot.app.known.sessions)
        await pilot.press("4")
        await until(pilot, lambda: "used" in text_of(pilot.app, "#verdict"))
        await pilot.press("v", "x")
        await until(pilot, lambda: f"Without pose {worst + 1}." in text_of(pilot.app, "#next"))
        await pilot.press("f9")
        await until(pilot, lambda: "1 view excluded by a person" in verdict(pilot))
        written = read_calibration(solved_session)
        assert written.excluded_views == [worst]
        assert f"pose {worst + 1}" in text_of(pilot.app, "#evidence")
        await pilot.press("u")
        await until(pilot, lambda: "PASS" in verdict(pilot) and "excluded" not in verdict(pilot))
        again = read_calibration(solved_session)
        assert again.excluded is None
        assert again.result == before.result


async def test_marks_are_taken_back_and_nothing_is_solved(link: FakeLink, solved_session: Path) -> None:
    link.root = solved_session.parents[2]
    before = solved_session.read_bytes()
    async with opened(link, size=(80, 24), notifications=True) as pilot:
        pilot.app.result_session = "s-1"
        await until(pilot, lambda: pilot.app.known.result)
        await pilot.press("4")
        await until(pilot, lambda: "used" in text_of(pilot.app, "#verdict"))
        views = pilot.app.screen.query_one("#views", DataTable)
        checks = pilot.app.screen.query_one("#checks", DataTable)
        assert not views.region.height and checks.region.height  # no room for both
        assert "v: views" in str(pilot.app.screen.query_one("#checks-box").border_title)
        await pilot.press("x")  # a key that was pressed on the checks marks nothing
        await until(pilot, lambda: views.has_focus and views.region.height and not checks.region.height)
        assert "Solve again" not in text_of(pilot.app, "#next")
        await pilot.press("x")
        await until(pilot, lambda: "Solve again" in text_of(pilot.app, "#next"))
        await pilot.press("x")
        await until(pilot, lambda: "Solve again" not in text_of(pilot.app, "#next"))
        await pilot.press("x", "u")
        await until(pilot, lambda: "Solve again" not in text_of(pilot.app, "#next"))
        await pilot.press("enter")
        await until(pilot, lambda: isinstance(pilot.app.screen, Explained))
        await pilot.press("enter")
        await until(pilot, lambda: isinstance(pilot.app.screen, ResultScreen))
        await pilot.press("v")
        await until(pilot, lambda: checks.has_focus and checks.region.height)
    assert solved_session.read_bytes() == before


async def test_a_result_without_a_recording_here_is_not_solved_again(link: FakeLink, tmp_path: Path) -> None:
    link.root = tmp_path
    path = tmp_path / "sessions" / "s-1" / CALIBRATION_FILE
    path.parent.mkdir(parents=True)
    write_calibration(small(), path)
    async with opened(link, size=(120, 36), notifications=True) as pilot:
        pilot.app.result_session = "s-1"
        await until(pilot, lambda: pilot.app.known.result)
        await pilot.press("4")
        await until(pilot, lambda: "excluded" in text_of(pilot.app, "#verdict"))
        await pilot.press("u")
        await until(pilot, lambda: "solve it where it is" in said(pilot))
