"""What another screen or a shell solves, installs or takes back is seen without leaving the screen."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from textual.widgets import DataTable

from calibrate.check.history import CheckEntry, append_check
from calibrate.files.calibration import Calibration, read_calibration, write_calibration
from calibrate.files.folders import calibrations_folder
from calibrate.files.install import install, rollback
from calibrate.files.versions import note_installed, who
from station.analysis.result_files import read_history, read_result, read_sessions
from station.cell.pose_plan import Plan
from station.cell.session_folder import SessionState, write_state
from station.tui.sessions import _row
from station.tui.task import next_action
from tests.tui.conftest import FakeLink, after_check, app_on, idle, in_session, opened, text_of, until
from tests.tui.test_install import GOOD, OFF


@pytest.fixture
def root(link: FakeLink, tmp_path: Path) -> Path:
    """Two solved sessions below the root of the daemon."""
    for name, created in (("s-1", "2026-01-01"), ("s-2", "2026-01-02")):
        folder = tmp_path / "sessions" / name
        folder.mkdir(parents=True)
        (folder / "session.mcap").touch()
        provenance = msgspec.structs.replace(GOOD.provenance, session=name)
        write_calibration(
            msgspec.structs.replace(GOOD, created=created, provenance=provenance), folder / "calibration.yaml"
        )
    link.root = tmp_path
    return tmp_path


def solve_of(root: Path, session: str) -> Calibration:
    return read_calibration(root / "sessions" / session / "calibration.yaml")


def put(root: Path, session: str) -> None:
    install(root / "sessions" / session / "calibration.yaml", root, cell="simulated")


async def test_the_list_of_sessions_names_what_is_installed_now(link: FakeLink, root: Path) -> None:
    async with opened(link) as pilot:
        app = pilot.app
        await pilot.press("5")
        await until(pilot, lambda: app.screen.query(DataTable))
        table = app.screen.query_one(DataTable)

        def states() -> list[str]:
            return [str(table.get_row_at(line)[1]) for line in range(table.row_count)]

        await until(pilot, lambda: states() == ["solved, not installed"] * 2)
        await pilot.press("end")
        put(root, "s-1")
        await until(pilot, lambda: states() == ["solved, not installed", "● INSTALLED"])
        assert table.cursor_row == 1  # what was marked still is
        put(root, "s-2")
        await until(pilot, lambda: states() == ["● INSTALLED", "installed before"])
        rollback(root)
        await until(pilot, lambda: states() == ["installed before", "● INSTALLED, unverified"])
        (root / "sessions" / "s-3").mkdir()
        await until(pilot, lambda: states()[0] == "c recovers it" and states()[2].startswith("● INSTALLED"))
        assert table.cursor_row == 2
        await pilot.press("enter")
        await until(pilot, lambda: app.current_mode == "result" and "Session s-1" in text_of(app, "#verdict"))


async def test_the_result_says_what_is_installed_and_who_took_it_back(link: FakeLink, root: Path) -> None:
    async with opened(link) as pilot:
        app = pilot.app
        await app.show_result("s-1")
        await until(pilot, lambda: "ready to install" in text_of(app, "#verdict"))
        assert "Nothing is installed" in text_of(app, "#evidence")
        put(root, "s-1")
        await until(pilot, lambda: "INSTALLED" in text_of(app, "#verdict"))
        assert "this one is installed" in text_of(app, "#evidence")
        put(root, "s-2")
        await until(pilot, lambda: "from the one before" in text_of(app, "#evidence"))
        assert "installed before" in text_of(app, "#verdict")
        rollback(root, reason="the camera had slipped")
        await app.show_result("s-2")
        await until(pilot, lambda: "had slipped" in text_of(app, "#verdict"))
        said = text_of(app, "#verdict")
        assert "installed before" in said
        assert "ready to install" not in said
        assert f"rollback by {who()}, 20" in said
        put(root, "s-2")
        await until(pilot, lambda: "INSTALLED" in text_of(app, "#verdict"))
        assert "rollback" not in text_of(app, "#verdict")


def test_a_check_by_hand_is_no_end_of_what_is_installed(root: Path) -> None:
    put(root, "s-1")
    note_installed(root, read_history(root, "main").installed.now, [OFF])
    assert read_result(root / "sessions" / "s-1" / "calibration.yaml", root).became == "INSTALLED, in doubt"
    put(root, "s-2")
    assert {c.provenance.session for c in read_history(root, "main").earlier} == {"s-1"}


async def test_a_session_that_was_solved_again_is_not_what_is_installed(link: FakeLink, root: Path) -> None:
    """The list, the result and what is shown before a session say the same of each solve."""
    put(root, "s-1")
    again = msgspec.structs.replace(solve_of(root, "s-1"), created="2026-01-03")
    write_calibration(again, root / "sessions" / "s-1" / "calibration.yaml")
    link.show(in_session(idle(), name="", poses=()))
    async with opened(link) as pilot:
        app = pilot.app
        await until(pilot, lambda: app.known.result and app.known.sessions)
        assert app.known.result.installed
        assert [kept.word for kept in app.known.sessions] == ["", ""]
        await app.show_result("s-1")
        await until(pilot, lambda: "ready to install" in text_of(app, "#verdict"))


async def test_after_a_drift_check_the_result_is_what_it_judged(link: FakeLink, root: Path) -> None:
    put(root, "s-1")
    app, folder = app_on(link), root / "sessions" / "s-2"
    (folder / "calibration.yaml").unlink()
    write_state(folder, SessionState("simulated", Plan("UR10", "eye-in-hand", ()), (), check=True))
    link.show(after_check(in_session(idle(), name="", poses=())))
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: app.known.result and app.known.sessions)
        assert next_action(app.known).key == "k"
        assert _row(app.known.sessions[0])[1].plain == "drift check"
        append_check(CheckEntry(0.0, 1, "s-2", True, (0.0,) * 6, 1.0, 12.6), root)
        await until(pilot, lambda: next_action(app.known).key == "d")


@pytest.mark.parametrize("elsewhere", [False, True])
async def test_before_a_session_the_result_is_what_is_installed(
    link: FakeLink, root: Path, elsewhere: bool
) -> None:
    """As a daemon knows nothing of the days before; and a file that cannot be read hides nothing else."""
    put(root, "s-1")
    (calibrations_folder(root) / "checks.jsonl").mkdir()
    if elsewhere:  # solved in a shell
        (root / "sessions" / "s-1" / "calibration.yaml").unlink()
    link.show(in_session(idle(), name="", poses=()))
    app = app_on(link)
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: app.known.result and app.known.sessions)
        assert app.known.result is not None and app.known.result.state.last and app.known.result.installed
        assert next_action(app.known).key == "d"
        await pilot.press("4")
        await until(
            pilot, lambda: app.current_mode == "result" and app.screen.does_something("app.drift_check")
        )
        link.show(in_session(idle(), name="s-3"))
        await until(pilot, lambda: app.known.result is None)


async def test_the_result_of_the_session_just_captured_needs_no_picking(link: FakeLink, root: Path) -> None:
    app, folder = app_on(link), root / "sessions" / "s-1"
    (folder / "calibration.yaml").rename(root / "later.yaml")
    link.show(in_session(idle(), folder=str(folder), recording=str(folder / "session.mcap")))
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: app.known.sessions is not None)
        assert app.known.result is None
        (root / "later.yaml").rename(folder / "calibration.yaml")  # another program solved it
        await pilot.press("4")
        await until(pilot, lambda: "Session s-1" in text_of(app, "#verdict"))


@pytest.mark.parametrize("instead", [False, True])
async def test_a_session_has_the_verdict_that_result_shows(link: FakeLink, root: Path, instead: bool) -> None:
    """Of a missed touch test, and of one that is installed with a reason."""
    path = root / "sessions" / "s-2" / "calibration.yaml"
    write_calibration(msgspec.structs.replace(solve_of(root, "s-2"), verification=[OFF]), path)
    if instead:
        install(path, root, cell="simulated", override="measured with the tape")
    found = {kept.session.name: kept for kept in read_sessions(root, "main")}
    assert found["s-2"].verdict == read_result(path, root).verdict == "PASS WITH A REASON"
    assert "PASS WITH A REASON" in _row(found["s-2"])[2].plain
    other = read_result(root / "sessions" / "s-1" / "calibration.yaml", root)
    assert found["s-1"].verdict == other.verdict
