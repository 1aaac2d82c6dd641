"""Installing, overruling with a reason, and going back, from the result screen."""

from __future__ import annotations

import io
from pathlib import Path

import msgspec
import pytest
from rich.console import Console
from textual.pilot import Pilot
from textual.widgets import Input, Static
from textual.widgets._footer import FooterKey

from calibrate.files.calibration import Calibration, read_calibration, write_calibration
from calibrate.files.folders import calibrations_folder, validity_of
from calibrate.files.formatting import figures, summary
from calibrate.files.install import install, installed_calibration
from calibrate.files.touch import Touch
from calibrate.files.validity import Validity, ValidityReason, ValidityState
from calibrate.files.versions import installed_versions, note_installed
from calibrate.results import Gate
from recordings.schema.messages import CameraIdentity, RobotIdentity
from station.analysis import result_files
from station.analysis.result_files import read_history
from station.cell.status import StationState
from station.protocol.results import Installed, Result
from station.tui.dialogs import Confirm, Reason
from station.tui.jobs import install_question
from station.tui.result import evidence, verdict_lines
from station.tui.task import next_action
from station.tui.words import local
from tests.station.calibrated_cell import calibration_of
from tests.station.session_rig import TRUTH
from tests.tui.conftest import FakeLink, app_on, idle, in_session, opened, said, text_of, until

GOOD = calibration_of(
    TRUTH, RobotIdentity(serial="1", model="UR10"), CameraIdentity(serial="2", model="camera")
)
OFF = Touch(0, (0.0, 0.0), (9.0, 0.0), (0.1, 0.1), "told by a person", "anna", "2026-01-01T00:00:00+00:00")
LATER = msgspec.structs.replace(GOOD, created="2026-02-01T00:00:00+00:00")
DOUBTED = msgspec.structs.replace(GOOD, verification=[OFF])


@pytest.fixture
def calibration(link: FakeLink, tmp_path: Path) -> Path:
    """Of session s-1, below the root of the daemon."""
    link.root = tmp_path
    path = tmp_path / "sessions" / "s-1" / "calibration.yaml"
    path.parent.mkdir(parents=True)
    write_calibration(DOUBTED, path)
    return path


@pytest.mark.parametrize(
    ("result", "verdict"),
    [
        (Result("", GOOD), "PASS"),
        (Result("", DOUBTED), "PASS WITH A REASON"),
        (Result("", GOOD, objections=("another camera",)), "PASS WITH A REASON"),
        (Result("", GOOD, Installed(GOOD)), "PASS"),
        (Result("", problem="damaged"), "FAIL"),
    ],
)
def test_there_is_one_verdict_in_three_states(result: Result, verdict: str) -> None:
    assert result.verdict == verdict
    if result.calibration is not None:
        assert verdict_lines(result).plain.split(", ")[0][2:] == verdict
        assert f"Session {GOOD.provenance.session}" in verdict_lines(result).plain
    else:
        assert verdict_lines(result).plain == result.problem


def test_terminal_and_screen_say_the_same_verdict_and_figures() -> None:
    printed = io.StringIO()
    Console(file=printed, width=200).print(summary(DOUBTED))
    screen = verdict_lines(Result("", DOUBTED)).plain + evidence(Result("", DOUBTED), DOUBTED).plain
    told = figures(DOUBTED)
    assert f"{Result('', DOUBTED).verdict}: " in printed.getvalue()
    assert {"error", "gates", "views", "touch"} <= set(told)
    for figure in told.values():
        assert figure.value in printed.getvalue()
        assert figure.value in screen


async def press_on_result(pilot: Pilot[None], calibration: Path, *keys: str) -> None:
    await until(pilot, lambda: "SIMULATED" in text_of(pilot.app, "#bar"))
    pilot.app.result_session = calibration.parent.name
    await pilot.press("4")
    await until(pilot, lambda: "PASS WITH A REASON" in text_of(pilot.app, "#verdict"))
    await pilot.press(*keys)


async def install_until_a_reason_is_asked_for(pilot: Pilot[None], calibration: Path) -> None:
    await press_on_result(pilot, calibration, "i")
    await until(pilot, lambda: isinstance(pilot.app.screen, Confirm))
    await pilot.press("tab", "enter")
    # Shown is not yet composed, on a busy computer.
    await until(pilot, lambda: isinstance(pilot.app.screen, Reason) and pilot.app.screen.query(Input))


async def test_who_overrules_gives_a_reason(link: FakeLink, calibration: Path) -> None:
    async with opened(link, notifications=True) as pilot:
        await install_until_a_reason_is_asked_for(pilot, calibration)
        await pilot.press("escape")
        await until(pilot, lambda: "Nothing was installed" in said(pilot))
        assert not installed_versions(calibration.parents[2])
        await install_until_a_reason_is_asked_for(pilot, calibration)
        shown = " ".join(str(part.render()) for part in pilot.app.screen.query(Static))
        assert "corner 0" in shown
        assert "--override" not in shown  # that is the shell's word
        await pilot.press("enter")  # without a reason nothing happens
        assert isinstance(pilot.app.screen, Reason)
        await pilot.press("x", "enter")  # nor with a pressed key
        assert isinstance(pilot.app.screen, Reason)
        assert text_of(pilot.app, "#dialog-problem")
        pilot.app.screen.query_one(Input).value = "measured with the tape"
        await pilot.press("enter")
        await until(pilot, lambda: "Installed" in said(pilot))
        await until(pilot, lambda: "“measured with the tape”" in text_of(pilot.app, "#verdict"))
    override = installed_calibration(calibration.parents[2]).override
    assert override is not None and override.reason == "measured with the tape"


async def test_going_back_names_both_and_asks(link: FakeLink, calibration: Path) -> None:
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await press_on_result(pilot, calibration, "b")
        await until(pilot, lambda: "Nothing is installed" in said(pilot))
        for path, made in ((calibration.with_name("a.yaml"), GOOD), (calibration.with_name("b.yaml"), LATER)):
            write_calibration(made, path)
            install(path, calibration.parents[2], cell="simulated")
        note_installed(calibration.parents[2], LATER, [OFF])  # a generation more, of the same solve
        await until(pilot, lambda: pilot.app.known.result.state.version == 3)
        await pilot.press("b")
        await until(pilot, lambda: isinstance(pilot.app.screen, Confirm))
        body = str(pilot.app.screen.query_one("#confirm-body", Static).render())
        assert f"Now: version 3, session {GOOD.provenance.session}, solved" in body
        assert "Before: version 1" in body
        await pilot.press("tab", "enter")
        await until(pilot, lambda: "installed again" in said(pilot))
    assert installed_calibration(calibration.parents[2]) == GOOD


async def test_a_first_installation_is_undone_by_taking_it_out_of_use(
    link: FakeLink, calibration: Path
) -> None:
    root = calibration.parents[2]
    write_calibration(GOOD, calibration)
    install(calibration, root, cell="simulated")
    async with opened(link, notifications=True) as pilot:
        pilot.app.result_session = calibration.parent.name
        await pilot.press("4")
        for answer in ("escape", "enter"):
            await until(pilot, lambda: "INSTALLED" in text_of(pilot.app, "#verdict"))
            assert validity_of(calibrations_folder(root), 1).state == "valid"
            await pilot.press("b")
            await until(pilot, lambda: isinstance(pilot.app.screen, Reason) and pilot.app.screen.query(Input))
            pilot.app.screen.query_one(Input).value = "the bracket was loose"
            await pilot.press(answer)
            await until(pilot, lambda: not isinstance(pilot.app.screen, Reason))
        await until(pilot, lambda: validity_of(calibrations_folder(root), 1).state == "withdrawn")
        await until(pilot, lambda: "WITHDRAWN" in text_of(pilot.app, "#verdict"))
        assert next_action(pilot.app.known).key != "d"
        await pilot.press("b")
        await until(pilot, lambda: "out of use" in said(pilot))
        assert not isinstance(pilot.app.screen, Reason)


async def test_a_result_that_is_worse_than_the_installed_one_is_not_called_ready(
    link: FakeLink, calibration: Path
) -> None:
    """`install` would ask for a reason: who looks at the result knows it before."""
    write_calibration(GOOD, calibration.with_name("a.yaml"))
    install(calibration.with_name("a.yaml"), calibration.parents[2], cell="simulated")
    vague = tuple(tuple(81 * value for value in row) for row in GOOD.covariance)
    write_calibration(msgspec.structs.replace(LATER, covariance=vague), calibration)
    async with opened(link) as pilot:
        pilot.app.result_session = calibration.parent.name
        await pilot.press("4")
        await until(pilot, lambda: "INSTALL" in text_of(pilot.app, "#verdict").upper())
        told = text_of(pilot.app, "#verdict")
        assert "PASS WITH A REASON, installs only with a reason" in told
        assert "Regression" in told
        link.show(in_session(idle(), name=""))  # a plan is loaded, no other session began
        await until(pilot, lambda: not pilot.app.known.shown.session.name)
        await pilot.pause(0.1)
        assert text_of(pilot.app, "#verdict") == told


@pytest.mark.parametrize("state", [StationState.IDLE, StationState.PAUSED, StationState.MOVING])
async def test_every_key_that_does_something_is_in_the_footer(
    link: FakeLink, calibration: Path, state: StationState
) -> None:
    install(calibration, calibration.parents[2], cell="simulated", override="measured with the tape")
    link.show(idle(state))
    async with opened(link) as pilot:
        await press_on_result(pilot, calibration)
        await until(pilot, lambda: pilot.app.screen.query("FooterKey"))
        keys = {key.key: key.region.right for key in pilot.app.screen.query(FooterKey)}
        assert max(keys.values()) <= 80 and "i" not in keys and "b" in keys
        assert ("d" in keys, "f6" in keys) == (state is not StationState.MOVING, state is StationState.MOVING)


def test_what_is_installed_and_its_validity_are_of_one_version(
    calibration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, read = calibration.parents[2], read_calibration
    write_calibration(GOOD, calibration)
    install(calibration, root, cell="simulated")

    def meanwhile(path: Path) -> Calibration:
        monkeypatch.setattr(result_files, "read_calibration", read)
        write_calibration(LATER, calibration)
        install(calibration, root, cell="simulated")
        return read(path)

    monkeypatch.setattr(result_files, "read_calibration", meanwhile)
    found = read_history(root, "main").installed
    assert found.now == GOOD and found.validity is not None and found.validity.version == 1


@pytest.mark.parametrize("created", ["0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59", "noon"])
def test_a_time_that_is_none_stays_as_it_is(created: str) -> None:
    assert local(created) == created


def test_a_calibration_that_no_longer_holds_says_so_where_it_said_installed() -> None:
    reason = ValidityReason("drift-check", "Drift check FAIL: camera shift 3.00 mm.")
    doubt = Validity(1, ValidityState.IN_DOUBT, "2026-11-22T04:50:00+00:00", reason)
    state = Installed(GOOD, validity=doubt)
    told = verdict_lines(Result("", GOOD, state)).plain
    assert Result("", GOOD, state).became == "INSTALLED, in doubt"
    assert "PASS, INSTALLED, in doubt" in told and reason.text in told


def test_a_withdrawn_calibration_never_reads_as_one_that_is_installed() -> None:
    reason = ValidityReason("withdrawn", "the camera was changed")
    validity = Validity(1, ValidityState.WITHDRAWN, "2026-11-22T04:50:00+00:00", reason)
    state = Installed(GOOD, validity=validity)
    told = verdict_lines(Result("", GOOD, state)).plain
    assert told.splitlines()[0].startswith("✗ WITHDRAWN") and "INSTALLED" not in told
    assert reason.text in told
    assert "INSTALLED" not in Result("", GOOD, state).became and "INSTALLED" not in state.held
    compared = evidence(Result("", LATER, state), LATER).plain
    assert "from the one before" not in compared and "withdrawn" in compared
    assert "from the one before" in evidence(Result("", LATER, Installed(GOOD)), LATER).plain


def test_the_question_before_installing_says_what_speaks_against_it() -> None:
    def asked(calibration: Calibration, *objections: str) -> tuple[str, str]:
        question = install_question(Result("", calibration, objections=objections), calibration)
        return str(question.title), question.words

    failing = Gate("views", False, 3.0, 8.0, "only 3 of 8 views")
    quality = msgspec.structs.replace(GOOD.quality, gates=(failing,))
    title, words = asked(msgspec.structs.replace(GOOD, quality=quality), "another camera")
    assert "FAIL" in title and "only 3 of 8 views" in words and "another camera" in words
    reasoned, words = asked(GOOD, "another camera")
    assert "FAIL" not in reasoned and "another camera" in words
    plain, words = asked(GOOD)
    assert len({title, reasoned, plain}) == 3 and "b undoes it" in words
