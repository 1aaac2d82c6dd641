"""The drift check from the sessions screen: refused where it says nothing, asked for, judged when sealed."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest
from textual.pilot import Pilot

from calibrate.files.calibration import write_calibration
from calibrate.files.install import install
from station.cell.errors import RefusedError
from station.cell.status import StationState, StationStatus
from station.tui import offline
from station.tui.app import StationApp
from station.tui.confirm import ConfirmGo
from station.tui.drift import INSTEAD, PLANNING_CHECK
from station.tui.jobs import JobScreen
from tests.tui.conftest import FakeLink, idle, until
from tests.tui.test_install import GOOD
from tests.tui.test_keys import app_on, text_of
from tests.tui.test_plan_screen import SlowPlanner

CHECK_PLAN = "cd" * 32
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
    link.answers["make_plan"] = {"poses": 6, "sha256": CHECK_PLAN}
    (tmp_path / "some_job.py").write_text(JOB)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(
        offline, "JobScreen", lambda title, module, *args, **more: JobScreen(title, "some_job", *args, **more)
    )
    return tmp_path


def check_session(root: Path, recording: str = "", state: StationState = StationState.IDLE) -> StationStatus:
    status = idle(state)
    session = msgspec.structs.replace(
        status.session,
        plan_sha256=CHECK_PLAN,
        folder=str(root / "root/sessions/s-2"),
        recording=recording,
    )
    return msgspec.structs.replace(status, session=session)


async def ask_for_it(pilot: Pilot[None]) -> None:
    await until(pilot, lambda: "SIMULATED" in text_of(pilot.app, "#bar"))
    await pilot.press("4", "d")


def said(app: StationApp, words: str) -> bool:
    return any(words in notice.message for notice in app._notifications)


async def test_nothing_is_planned_where_nothing_is_installed(link: FakeLink, tmp_path: Path) -> None:
    link.root = tmp_path
    app = app_on(link)
    async with app.run_test(size=(80, 24), notifications=True) as pilot:
        await ask_for_it(pilot)
        await until(
            pilot, lambda: said(app, "nothing is installed. 3 shows the newest result, i installs it")
        )
        assert link.verbs == []


async def test_what_the_daemon_refuses_is_said(link: FakeLink, installed: Path) -> None:
    link.refuse["make_plan"] = RefusedError("a session is open: finish it first")
    app = app_on(link)
    async with app.run_test(size=(80, 24), notifications=True) as pilot:
        await ask_for_it(pilot)
        await until(pilot, lambda: said(app, "a session is open"))
        assert "prepare" not in link.verbs and not app.busy


async def test_a_no_leaves_arm_and_plan_as_they_were(link: FakeLink, installed: Path) -> None:
    link.answers["plan"] = {"plan": {"poses": [1, 2, 3]}, "sha256": "ab" * 32}
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await ask_for_it(pilot)
        await until(pilot, lambda: pilot.app.screen.query("#confirm-body"))
        body = " ".join(text_of(pilot.app, "#confirm-body").split())
        assert INSTEAD.format(3) in body
        await pilot.press("escape")
        await until(pilot, lambda: link.verbs[-1] == "load_plan")
        assert ("load_plan", {"plan": {"poses": [1, 2, 3]}}) in link.asked
        assert "go" not in link.verbs


async def test_a_plan_that_was_used_is_not_missed(link: FakeLink, installed: Path) -> None:
    status = idle()
    poses = (msgspec.structs.replace(status.session.poses[0], attempt=1), *status.session.poses[1:])
    link.show(msgspec.structs.replace(status, session=msgspec.structs.replace(status.session, poses=poses)))
    app = app_on(link)
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: app.status is not None and app.status.session.poses == poses)
        await ask_for_it(pilot)
        await until(pilot, lambda: app.screen.query("#confirm-body"))
        assert "plan" not in link.verbs
        assert "takes the place" not in text_of(app, "#confirm-body")
        await pilot.press("escape")
        await until(pilot, lambda: not isinstance(app.screen, ConfirmGo))
        await pilot.pause()
        assert "load_plan" not in link.verbs


async def test_the_verdict_comes_when_the_recording_is_sealed(link: FakeLink, installed: Path) -> None:
    recording = str(installed / "root/sessions/s-2/session.mcap")
    app = app_on(link)
    async with app.run_test(size=(80, 24), notifications=True) as pilot:
        await ask_for_it(pilot)
        await until(pilot, lambda: isinstance(app.screen, ConfirmGo))
        assert "go" not in link.verbs
        assert any(args.get("purpose") == "check" for _, args in link.asked)
        await pilot.press("tab", "enter")
        await until(pilot, lambda: "go" in link.verbs and app.current_mode == "live")
        link.show(check_session(installed, state=StationState.PAUSED))
        await until(pilot, lambda: "PAUSED" in text_of(app, "#bar"))
        link.show(check_session(installed, recording, StationState.SEALING))
        await until(pilot, lambda: "SEALING" in text_of(app, "#bar"))
        await pilot.pause(0.3)
        assert not (installed / "asked").exists()
        link.show(check_session(installed, recording))
        await until(pilot, lambda: (installed / "asked").exists() and isinstance(app.screen, JobScreen))
        asked = json.loads((installed / "asked").read_text())
        assert asked == ["check", recording, "--root", str(installed / "root")]
        await until(pilot, lambda: any("holds" in line for line in app.screen.said))  # type: ignore[attr-defined]


async def test_another_plan_ends_it_without_a_verdict(link: FakeLink, installed: Path) -> None:
    app = app_on(link)
    async with app.run_test(size=(80, 24), notifications=True) as pilot:
        await ask_for_it(pilot)
        await until(pilot, lambda: isinstance(app.screen, ConfirmGo))
        await pilot.press("tab", "enter")
        link.show(check_session(installed))
        await until(pilot, lambda: app.status == check_session(installed))
        await pilot.pause(0.3)
        link.show(idle())
        await until(pilot, lambda: said(app, "no verdict"))
        assert not (installed / "asked").exists()


async def test_planning_it_is_said_on_every_screen() -> None:
    link = SlowPlanner()
    app = app_on(link)
    async with app.run_test(size=(80, 24)) as pilot:
        await ask_for_it(pilot)
        await until(pilot, lambda: PLANNING_CHECK in text_of(app, "#reason"))
        await pilot.press("5")
        await until(pilot, lambda: app.current_mode == "log" and PLANNING_CHECK in text_of(app, "#reason"))
        link.show(idle(StationState.PAUSED, "poses 3, 7 failed: retake or skip them, or finish"))
        await until(pilot, lambda: "poses 3, 7 failed" in text_of(app, "#reason"))
        assert text_of(app, "#reason").strip().startswith(PLANNING_CHECK)  # a long reason may be cut
        link.made.set()
        await until(pilot, lambda: not app.busy)
