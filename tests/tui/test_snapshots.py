"""Every screen and question as it looks in fixed states, against its snapshot (see `snapshots.py`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from textual.screen import Screen
from textual.widgets import Input

from calibrate.check.history import CheckEntry
from calibrate.files.calibration import Calibration
from calibrate.files.validity import Validity, ValidityReason, ValidityState
from calibrate.results import Gate, PointError, RejectedView, Sense, ViewQuality, ViewWeight
from calibrate.words import word_of, words_of_gates
from recordings.cli.console import ProgressLine
from recordings.schema.messages import RobotIdentity
from station.cell.session_folder import SessionSummary
from station.cell.status import (
    NO_IMAGE,
    ArmCondition,
    DetectionStatus,
    EstimateStatus,
    Event,
    RecorderStatus,
    StationState,
    StationStatus,
)
from station.operate.cell_setup import CellSetup
from station.operate.draft import CellStep
from station.protocol.results import Installed, Kept, Result
from station.protocol.verbs import Check, ResultData, SessionsData
from station.tui.app import StationApp
from station.tui.dialogs import READ, ConfirmFinish, ConfirmMotion, JobScreen, Reason
from station.tui.help import Explained, Help
from station.tui.jobs import install_question
from station.tui.new_cell import NewCell
from station.tui.new_cell_steps import PAGES
from station.tui.touch_corners import TouchCorners
from tests.tui.conftest import (
    SUMMARY,
    FakeLink,
    app_on,
    commanded,
    idle,
    in_session,
    text_of,
    until,
    with_robot,
)
from tests.tui.snapshots import FOLDER, SIZES, compare
from tests.tui.test_by_hand import by_hand
from tests.tui.test_capture import seeing
from tests.tui.test_excluded_views import small
from tests.tui.test_install import GOOD, OFF

NOON_NS = 1_790_000_000_000_000_000
STANDING = (0.0, -1.6, -1.5, -1.6, 1.5, 0.0)
FIGURES: dict[str, tuple[float, Sense, float, str]] = {
    "views": (25, "≥", 8, ""),
    "weight": (0.97, "≥", 0.8, "share"),
    "rotation_deg": (81.0, "≥", 30.0, "deg"),
    "axis_spread": (0.71, "≥", 0.1, ""),
    "view_rms_px": (0.42, "≤", 1.5, "px"),
    "holdout_share": (0.0012, "≤", 0.01, "share"),
    "cross_validation": (0.93, "≤", 1.0, ""),
    "coverage": (0.64, "≥", 0.25, "share"),
    "lens_pull": (0.31, "≤", 1.0, ""),
    "board_pull": (0.0, "≤", 1.0, ""),
    "clock_bound_s": (0.0044, "≤", 0.02, "s"),
    "predicted_error_m": (0.00053, "≤", 0.002, "m"),
    "robot_error_m": (0.00005, "≤", 0.002, "m"),
    "robot_error_deg": (0.005, "≤", 0.3, "deg"),
}
"""Value, side, limit and unit of the gates that the snapshots show."""
POINT = PointError(0.53, 0.5, 0.9, 0.61, 0.1, 0.47, 0.22, 0.47, 0.52, "learned")


def gate(name: str, value: float | None = None) -> Gate:
    found, sense, limit, unit = FIGURES[name]
    word = words_of_gates()[name]
    return Gate.measured(name, word.title, found if value is None else value, sense, limit, unit, word.bad)


@pytest.fixture(autouse=True)
def one_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same terminal, time zone and moment everywhere."""
    for name in ("NO_COLOR", "TEXTUAL_THEME", "SSH_TTY", "SSH_CONNECTION", "COLUMNS", "LINES"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    stands = SimpleNamespace(monotonic=lambda: 1000.0)
    monkeypatch.setattr("station.tui.dialogs.time", stands)
    monkeypatch.setattr(Input, "cursor_blink", False, raising=False)


PROGRESS = msgspec.json.encode(ProgressLine("finding the board in the images", 12, 25)).decode()
WORK = {
    "work-under-way": ["import time", f"print('{PROGRESS}', flush=True)", "time.sleep(600)"],
    "work-passed": ["print('The camera pose holds on 8 new views.')"],
    "work-failed": ["print('Camera shift 1.31 mm, 0.210°.')", "raise SystemExit(4)"],
    "work-not-done": ["print('No board in any view.')", "raise SystemExit(1)"],
}
"""Programs that a work window runs, by the name of the snapshot."""


def fresh() -> StationStatus:
    return in_session(idle(), name="", poses=())


def planned(state: StationState = StationState.IDLE, captured: int = 0, **session: object) -> StationStatus:
    """A plan of 25 poses; of the captured ones the third and the sixth need a look."""
    poses = []
    for pose in idle().session.poses:
        taken = pose.index < captured
        poses.append(
            msgspec.structs.replace(
                pose,
                state="failed" if taken and pose.index == 5 else "done" if taken else "planned",
                reason="the board is cut" if taken and pose.index == 5 else "",
                kept=taken and pose.index == 2,
                predicted_sigma_mm=2.0 / (pose.index + 1) ** 0.5,
                estimated_sigma_mm=1.6 / (pose.index + 1) ** 0.5 if taken else None,
                base_from_flange=seeing(
                    0.5 + 0.051 * (pose.index // 5), 0.053 * (pose.index % 5) - 0.1
                ).base_from_flange,
            )
        )
    views = tuple(tuple((row + column + captured) % 4 for column in range(4)) for row in range(3))
    estimate = EstimateStatus(
        captured, predicted_error_mm=0.53, working_distance_m=0.5, image_views=views if captured else ()
    )
    status = msgspec.structs.replace(
        commanded(state) if state is not StationState.IDLE else idle(),
        estimate=estimate,
        recorder=RecorderStatus(free_bytes=58_100_000_000),
        detection=DetectionStatus(
            found=True, corners=42, expected=42, coverage=0.31, tilt_rad=0.4, distance_m=0.48
        ),
    )
    status = with_robot(status, state=msgspec.structs.replace(status.robot.state, joints_rad=STANDING))
    return in_session(status, poses=tuple(poses), captured=captured, working_distance_m=0.5, **session)


def stopped(state: StationState, reason: str, **robot: object) -> StationStatus:
    status = msgspec.structs.replace(planned(state, captured=9), reason=reason, cause="stop")
    return with_robot(status, still=True, **robot)


MISSING = (
    Check("robot", "ok", "UR10 20195000000 answers, remote control"),
    Check("camera", "failed", "no camera answers", "Check its power and its cable."),
    Check("disk", "ok", "58.1 GB are free"),
    Check("trigger", "skipped", "none is configured"),
    Check("accepted", "warning", "its stops were never tested", "Run station accept."),
)
READY = tuple(msgspec.structs.replace(check, state="ok", remedy="") for check in MISSING)


@dataclass(frozen=True)
class Shot:
    """A state of the station, and what is opened on it."""

    status: StationStatus
    mode: str = "capture"
    checks: tuple[Check, ...] = READY
    result: Result | None = None
    sessions: tuple[Kept, ...] = ()
    known: dict[str, Any] = field(default_factory=dict)
    """What the screen knows besides what the daemon tells."""
    over: Callable[[Screen[Any]], Screen[Any]] | None = None
    """Makes a window over the screen."""
    keys: tuple[str, ...] = ()
    """Pressed at last."""


def solved(gates: list[Gate], rejected: Sequence[RejectedView] = ()) -> Calibration:
    quality = msgspec.structs.replace(
        GOOD.quality,
        gates=gates,
        point=POINT,
        predicted_error_mm=POINT.error_mm,
        working_distance_m=POINT.at_m,
        views=[ViewQuality(k, 0.12 + 0.012 * k, 0.05 + 0.007 * k, 0.004 + 0.0005 * k) for k in range(25)],
    )
    weights = [ViewWeight(k, 1.0 if k < 23 else 0.61) for k in range(25)]
    views = msgspec.structs.replace(GOOD.views, rejected=list(rejected), weights=weights)
    return msgspec.structs.replace(GOOD, quality=quality, views=views)


PASSED = solved([gate(name) for name in FIGURES])
FAILED = solved(
    [gate(name, {"rotation_deg": 19.3, "coverage": 0.11}.get(name)) for name in FIGURES],
    [RejectedView(7, "p08", "robot pose and image differ by 3.1 mm, 0.4°", "wrong-pose")],
)
TAKEN_OUT = Validity(
    1,
    ValidityState.WITHDRAWN,
    "2026-09-20T10:00:00+00:00",
    ValidityReason("withdrawn", "the camera was changed"),
)
CHECKED = CheckEntry(NOON_NS / 1e9, 1, "s-2", True, (0.0002, 0.0, 0.0, 0.0, 0.0, 0.0), 3.1, 12.6, 0.79)
ERROR = ("± 0.53 mm (1σ)", "at 500 mm")


def kept(day: int, views: int, sealed: bool = True, check: bool = False) -> SessionSummary:
    name = f"202609{day}-101500-cell"
    return SessionSummary(name, f"/s/{name}", f"/s/{name}/r.mcap", views, check, sealed, "")


KEPT = (
    Kept(kept(22, 12, sealed=False)),
    Kept(kept(21, 8, check=True), check=CHECKED),
    Kept(kept(20, 25), "PASS", "INSTALLED", ERROR),
    Kept(kept(19, 25), "FAIL", "", ERROR),
    Kept(kept(18, 25)),
)
EVENTS = tuple(
    Event(NOON_NS + 7_000_000_000 * number, level, text, pose)
    for number, (level, text, pose) in enumerate(
        (
            ("info", "motion approved by anna, terminal window 3", None),
            ("info", "saved", 0),
            ("warning", "not settled after 4.0 s: the image moves", 1),
            ("error", "the board is cut", 1),
        )
    )
)


def after(result: Result, mode: str = "result", **more: Any) -> Shot:
    recorded = planned(captured=25, recording="/s/1/r.mcap")
    return Shot(recorded, mode, result=result, sessions=KEPT, **more)


GOOD_RESULT = Result("/s/1/c.yaml", PASSED)
HANDS = msgspec.structs.replace(by_hand(4, still=0.6, moves="the image moves", after_mm=0.9))
SHOTS: dict[str, Shot] = {
    "connect-missing": Shot(fresh(), "connect", checks=MISSING),
    "connect-ready": Shot(fresh(), "connect"),
    "connect-no-robot": Shot(
        with_robot(
            msgspec.structs.replace(
                fresh(), state=StationState.DISCONNECTED, reason="192.168.1.10 does not answer"
            ),
            state=None,
        ),
        "connect",
        checks=MISSING,
    ),
    "plan-none": Shot(fresh(), "plan"),
    "plan-25": Shot(planned(), "plan"),
    "plan-captured": Shot(planned(StationState.PAUSED, captured=9), "plan", keys=("down", "down")),
    "capture-idle": Shot(fresh()),
    "capture-moving": Shot(
        planned(StationState.MOVING, captured=9, current=9, remaining_s=64.0, elapsed_s=41.0)
    ),
    "capture-paused": Shot(planned(StationState.PAUSED, captured=9)),
    "capture-stopped": Shot(stopped(StationState.STOPPED, "STOP by anna, terminal window 3")),
    "capture-fault": Shot(
        stopped(
            StationState.FAULT,
            "protective stop",
            condition=ArmCondition(safety="PROTECTIVE STOP", held="clear the protective stop"),
        )
    ),
    "capture-by-hand": Shot(HANDS),
    "capture-elsewhere": Shot(
        msgspec.structs.replace(
            planned(StationState.PAUSED, captured=9),
            lease=msgspec.structs.replace(commanded(StationState.PAUSED).lease, client_id=8),
        )
    ),
    "capture-no-image": Shot(
        msgspec.structs.replace(
            planned(), detection=DetectionStatus(cause=NO_IMAGE, reason="the camera gives no image")
        )
    ),
    "capture-no-answer": Shot(planned(StationState.MOVING, captured=9, current=9), known={"silent_s": 4.0}),
    "capture-no-daemon": Shot(planned(StationState.MOVING, captured=9), known={"gone": "The daemon ended."}),
    "capture-posted": Shot(
        with_robot(fresh(), by_hand=True, identity=RobotIdentity("xArm 6"), notice="pose 0.2 s old")
    ),
    "capture-playback": Shot(msgspec.structs.replace(planned(captured=9), source="playback")),
    "result-none": Shot(planned(captured=25, recording="/s/1/r.mcap"), "result"),
    "result-pass": after(GOOD_RESULT),
    "result-marked": after(GOOD_RESULT, keys=("v", "down", "x")),
    "result-fail": after(Result("/s/1/c.yaml", FAILED)),
    "result-reason": after(Result("/s/1/c.yaml", PASSED, objections=("Regression: 0.31 mm (limit 0.20)",))),
    "result-touched": after(Result("/s/1/c.yaml", msgspec.structs.replace(PASSED, verification=[OFF]))),
    "result-installed": after(Result("/s/1/c.yaml", PASSED, Installed(PASSED, drift=(CHECKED,)))),
    "result-withdrawn": after(Result("/s/1/c.yaml", PASSED, Installed(PASSED, validity=TAKEN_OUT))),
    "result-excluded": after(Result("/s/1/c.yaml", small()), keys=("v", "down", "down", "down", "x")),
    "result-unreadable": after(Result("/s/1/c.yaml", problem="calibration.yaml: damaged, or edited by hand")),
    "sessions-none": Shot(fresh(), "sessions"),
    "sessions": after(GOOD_RESULT, "sessions"),
    "log": Shot(msgspec.structs.replace(planned(), events=EVENTS), "log"),
    "help": Shot(fresh(), over=Help),
    "help-searched": Shot(fresh(), over=Help, keys=tuple("gate")),
    "explained": after(GOOD_RESULT, over=lambda _: Explained("gate", "15 of 15 passed", [word_of("gate")])),
    "question-motion": Shot(planned(), over=lambda _: ConfirmMotion(SUMMARY)),
    "question-finish": Shot(planned(StationState.PAUSED, captured=9), over=lambda _: ConfirmFinish()),
    "question-install": after(
        Result("/s/1/c.yaml", FAILED), over=lambda _: install_question(Result("", FAILED), FAILED)
    ),
    "question-reason": after(
        Result("/s/1/c.yaml", FAILED),
        over=lambda _: Reason(
            "Not installed", "Rotation range: 1 (≤ 2) FAIL. Do it.\n\nEnter installs, Escape does not."
        ),
    ),
    "touch-corners": after(GOOD_RESULT, over=lambda _: TouchCorners(SimpleNamespace(calibration=PASSED))),
}


def tell(link: FakeLink, shot: Shot) -> None:
    """Let the daemon answer with what the shot shows."""
    link.same_image = True
    link.answers["doctor"] = shot.checks
    link.answers["result"] = ResultData(None if shot.result is None else msgspec.to_builtins(shot.result))
    link.answers["sessions"] = SessionsData(tuple(msgspec.to_builtins(kept) for kept in shot.sessions))
    link.show(shot.status)


def knows(app: StationApp, shot: Shot) -> bool:
    """Tell whether the daemon's answers have come."""
    now = app.known
    has_result = (now.result is None) is (shot.result is None)
    has_checks = now.works or now.checks == shot.checks
    return now.status == shot.status and now.sessions == shot.sessions and has_result and has_checks


@pytest.mark.parametrize("name", SHOTS)
async def test_a_screen_looks_as_it_did(link: FakeLink, name: str) -> None:
    shot = SHOTS[name]
    tell(link, shot)
    app = app_on(link)
    async with app.run_test(size=SIZES[0], notifications=True) as pilot:
        await until(pilot, lambda: knows(app, shot))
        await app.switch_mode(shot.mode)
        await until(pilot, lambda: app.screen.query("#content"))
        app.known = replace(app.known, **shot.known)
        await until(pilot, lambda: app.screen.known is app.known)
        if shot.over is not None:
            await app.push_screen(shot.over(app.screen))
        await pilot.press(*shot.keys)
        await compare(pilot, name)


@pytest.mark.parametrize("name", WORK)
async def test_long_work_looks_as_it_did(
    link: FakeLink, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (tmp_path / "some_job.py").write_text("\n".join(WORK[name]))
    shot = Shot(planned(captured=25, recording="/s/1/r.mcap"))
    tell(link, shot)
    app = app_on(link)
    async with app.run_test(size=SIZES[0]) as pilot:
        await until(pilot, lambda: knows(app, shot))
        work = JobScreen("Drift check on 20260920-101500-cell", "some_job", close_on=(), passed="PASS")
        await app.push_screen(work)
        await until(pilot, lambda: work.NEXT is READ or "12 of 25" in text_of(app, "#job-bar"))
        await compare(pilot, name)


class NoHardware:
    """There is nothing to connect to."""

    async def cameras(self) -> tuple[()]:
        return ()

    async def genicam_problem(self) -> None:
        return None


@pytest.mark.parametrize("step", [step for step in CellStep if step in PAGES and step is not CellStep.SAVE])
async def test_a_step_of_the_wizard_looks_as_it_did(tmp_path: Path, step: CellStep) -> None:
    app = NewCell(CellSetup(NoHardware(), tmp_path, Path("station.yaml")))
    async with app.run_test(size=SIZES[0]) as pilot:
        await until(pilot, lambda: "READ ONLY" in text_of(app, "#bar"))
        app.step = step
        await compare(pilot, f"wizard-{step.value}")


def test_every_snapshot_has_its_test() -> None:
    wizard = [f"wizard-{step.value}" for step in CellStep if step in PAGES and step is not CellStep.SAVE]
    expected = {f"{name}-{w}x{h}.txt" for name in [*SHOTS, *WORK, *wizard] for w, h in SIZES}
    assert {path.name for path in FOLDER.iterdir()} == expected
