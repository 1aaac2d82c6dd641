"""The drift check from the sessions screen: refused where it says nothing, asked for, judged when sealed."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from calibrate.check.history import CheckEntry, Trend, append_check
from calibrate.files.calibration import write_calibration
from calibrate.files.install import install
from station.analysis.result_files import read_history
from station.cell.status import StationState, StationStatus
from station.protocol import verbs
from station.protocol.results import Installed, Result
from station.tui import jobs
from station.tui.dialogs import ConfirmMotion, JobScreen
from station.tui.result import check_rows
from tests.tui.conftest import FakeLink, after_check, idle, in_session, opened, said, text_of, until
from tests.tui.test_install import GOOD

JOB = """
import json, pathlib, sys
(pathlib.Path(__file__).parent / "asked").write_text(json.dumps(sys.argv[1:]))
print("The installed calibration holds.")
"""


@pytest.fixture
def installed(link: FakeLink, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The daemon's root, with something installed; the check itself is a job that notes what it was asked."""
    write_calibration(GOOD, tmp_path / "c.yaml")
    link.root = tmp_path / "root"
    install(tmp_path / "c.yaml", root=link.root, cell="simulated")
    (tmp_path / "some_job.py").write_text(JOB)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(
        jobs, "JobScreen", lambda title, module, *args, **more: JobScreen(title, "some_job", *args, **more)
    )
    return tmp_path


def check_session(state: StationState) -> StationStatus:
    return in_session(idle(state), name="s-2", check=True)


def finished(recording: str, state: StationState = StationState.IDLE) -> StationStatus:
    return after_check(idle(state), folder=str(Path(recording).parent), recording=recording)


async def test_nothing_is_planned_where_nothing_is_installed(link: FakeLink, tmp_path: Path) -> None:
    link.root = tmp_path
    # A narrower screen shortens a path as long as this in its middle.
    async with opened(link, size=(200, 50), notifications=True) as pilot:
        await pilot.press("4", "d")
        await until(pilot, lambda: str(link.root) in said(pilot))
        assert link.verbs == []


async def test_the_verdict_comes_when_the_recording_is_sealed(link: FakeLink, installed: Path) -> None:
    recording = str(installed / "root/sessions/s-2/session.mcap")
    async with opened(link) as pilot:
        app = pilot.app
        await pilot.press("4", "d")
        await until(pilot, lambda: isinstance(app.screen, ConfirmMotion))
        assert "go" not in link.verbs
        assert verbs.Prepare(verbs.Purpose.DRIFT_CHECK) in link.asked
        await pilot.press("tab", "enter")
        await until(pilot, lambda: "go" in link.verbs and app.current_mode == "capture")
        link.show(check_session(StationState.PAUSED))
        await until(pilot, lambda: "PAUSED" in text_of(app, "#bar"))
        link.show(finished(recording, StationState.SEALING))
        await until(pilot, lambda: "SEALING" in text_of(app, "#bar"))
        await pilot.pause(0.3)
        assert not (installed / "asked").exists()
        link.show(finished(recording))
        await until(pilot, lambda: isinstance(app.screen, JobScreen) and app.screen.said)
        asked = json.loads((installed / "asked").read_text())
        assert asked == ["drift-check", recording, "--root", str(installed / "root")]
        await until(pilot, lambda: any("holds" in line for line in app.screen.said))


def test_what_each_check_found_is_a_row_that_tells_what_to_do() -> None:
    held = CheckEntry(0.0, 1, "r", True, (0.0,) * 6, 1.0, 12.6)
    weak, sure = (msgspec.structs.replace(held, passed=False, p_value=p_value) for p_value in (0.01, 1e-5))
    creeping = msgspec.structs.replace(held, trend=Trend(0.4, 0.0, 40.0, 8))
    drift = (sure, weak, creeping, held)
    newest_first = check_rows(Result("", GOOD, Installed(GOOD, drift=drift)), GOOD)[-4:]
    assert [cells[0].plain[0] for cells, _, _ in newest_first] == ["✓", "▲", "✗", "✗"]
    assert len({advice for _, advice, _ in newest_first}) == 4


def test_the_history_is_of_this_camera_and_of_what_is_installed(tmp_path: Path) -> None:
    path, root = tmp_path / "c.yaml", tmp_path / "root"
    for camera in ("left", "right"):
        write_calibration(GOOD, path)
        number = install(path, root, cell="simulated", camera=camera).number
        entry = CheckEntry(0.0, number, camera, True, (0.0,) * 6, 1.0, 12.6)
        append_check(entry, root, camera)
    assert [check.recording for check in read_history(root, "right").installed.drift] == ["right"]
    assert not read_history(root, "main").installed.drift
    write_calibration(msgspec.structs.replace(GOOD, created="2026-02-01T00:00:00+00:00"), path)
    install(path, root, cell="simulated", camera="right")
    assert not read_history(root, "right").installed.drift and read_history(root, "left").installed.drift
