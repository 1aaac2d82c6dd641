"""The command line's contract: JSON objects, exit codes, one-paragraph errors, nothing half-written."""

from __future__ import annotations

import json
import os
import pkgutil
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate import load_installed
from calibrate.check.history import append_check, read_checks
from calibrate.errors import InstallError
from calibrate.files import lines, validity_writer
from calibrate.files.calibration import read_calibration, write_calibration
from calibrate.files.install import install
from calibrate.files.touch import Touch
from calibrate.files.validity import ValidityState
from calibrate.files.versions import note_installed
from recordings.cli.console import ProgressLine
from recordings.schema.messages import CameraIdentity, RobotIdentity
from tests.calibrate.calling import refused, run
from tests.calibrate.sessions import Scene, shifted, write_session
from tests.codes import raises
from tests.patience import wait_until


def test_solve_json_says_what_the_file_holds(
    small_session_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CALIBRATE_PROGRESS", "json")  # as the screen asks for it
    (tmp_path / "xdg-open").write_text('#!/bin/sh\ncp "$1" opened.new && mv opened.new opened\n')
    (tmp_path / "xdg-open").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("DISPLAY", ":99")
    done = run("solve", small_session_file, "-o", tmp_path / "c.yaml", "--json", "--open", cwd=tmp_path)
    assert done.returncode in (0, 4), done.stderr
    assert done.stdout.count("\n") == 1
    told = [msgspec.json.decode(line, type=ProgressLine) for line in done.stderr.splitlines()]
    whole = {line.total for line in told if line.done == line.total}
    assert whole == {5, 4}, "all images, and all stages of solving"
    wait_until((tmp_path / "opened").exists)
    assert (tmp_path / "opened").read_text().startswith("<!doctype html>")
    answer = json.loads(done.stdout)
    assert [view["index"] for view in answer["views"]["weights"]] == answer["views"]["used"]
    assert answer["verdict"] == ("pass" if all(gate["passed"] for gate in answer["gates"]) else "fail")
    assert answer["session"]["hypothesis"] == "as-recorded"
    assert done.returncode == (0 if all(gate["passed"] for gate in answer["gates"]) else 4)
    written = read_calibration(tmp_path / "c.yaml")
    assert written.result.translation_m == tuple(answer["result"]["translation_m"])


def test_a_failed_gate_is_exit_4_and_the_file_is_written_and_will_not_install(
    real_session_file: Path, tmp_path: Path
) -> None:
    (tmp_path / "gates.yaml").write_text("views: 20\n")
    done = run("solve", real_session_file, "-o", "c.yaml", "--gates", "gates.yaml", cwd=tmp_path)
    assert done.returncode == 4
    (gate,) = read_calibration(tmp_path / "c.yaml").quality.failed
    assert (gate.name, gate.value, gate.limit) == ("views", 14, 20)
    refused(run("install", "c.yaml", cwd=tmp_path), 4, "gate-failed", "--override")
    assert run("install", "c.yaml", "--override", "trial", cwd=tmp_path).returncode == 0
    shown = run("show", "--json", cwd=tmp_path)
    assert json.loads(shown.stdout)["override"]["reason"] == "trial"


def test_solve_install_check_rollback(real_session_file: Path, real_file: Path, tmp_path: Path) -> None:
    """The operator's round: two calibrations, a look at each, a check, and back."""
    second = tmp_path / "second.yaml"
    calibration = read_calibration(real_file)
    moved = shifted(calibration, 0.02)
    arm_error = tuple(map(tuple, np.diag(np.full(6, 1e-10)).tolist()))  # stated, as by --robot-accuracy-mm
    posterior = msgspec.structs.replace(
        calibration.posterior, X=moved.result.matrix, stated_arm_error=arm_error
    )
    write_calibration(msgspec.structs.replace(moved, posterior=posterior), second)
    first = run("install", real_file, cwd=tmp_path)
    assert first.returncode == 0 and "calibrate withdraw" in first.stdout
    annotated = tmp_path / "annotated.mcap"
    assert run("annotate", real_session_file, real_file, "-o", annotated, cwd=tmp_path).returncode == 0
    for own in (real_session_file, annotated):
        done = run("drift-check", own, "--json", cwd=tmp_path)
        answer = json.loads(done.stdout)
        assert (done.returncode, answer["own_views"], answer["passed"]) == (1, True, False)
    later = Scene(views=6, seed=17)
    new = write_session(tmp_path / "new.mcap", later, known_lens=True, source="real", name="later")
    holds = run("drift-check", new, "--json", cwd=tmp_path)
    assert holds.returncode == 0, holds.stdout + holds.stderr
    assert json.loads(holds.stdout)["passed"] is True and json.loads(holds.stdout)["own_views"] is False
    installed = run("install", second, "--json", cwd=tmp_path)
    assert json.loads(installed.stdout)["generation"] == 2
    assert run("drift-check", real_session_file, cwd=tmp_path).returncode == 4
    other = msgspec.structs.replace(later.board, flatness_m=0.002)
    (tmp_path / "board.yaml").write_bytes(msgspec.json.encode(other))
    assert run("drift-check", new, "--board", "board.yaml", cwd=tmp_path).returncode == 4
    logged = read_checks(tmp_path / "state/calibration-station")
    assert [entry.board for entry in logged] == [None, other]
    _everything_says_that_it_is_in_doubt(tmp_path)
    assert run("rollback", "--reason", "moved", cwd=tmp_path).returncode == 0
    listed = json.loads(run("list", "--json", cwd=tmp_path).stdout)
    assert [(row["generation"], row["current"]) for row in listed] == [(1, True), (2, False)]
    session = calibration.provenance.session
    assert [row["session"] for row in listed] == [session, session]
    assert run("list", cwd=tmp_path).stdout.count(session) == 2
    text = run("export", "--to", "urdf", cwd=tmp_path)
    assert text.stdout.count("<joint") == 2


def _everything_says_that_it_is_in_doubt(folder: Path) -> None:
    listed = json.loads(run("list", "--json", cwd=folder).stdout)
    assert [row["validity"]["state"] for row in listed] == ["valid", "in-doubt"]
    shown = json.loads(run("show", "--json", cwd=folder).stdout)["validity"]
    assert (shown["state"], shown["reason"]["code"], shown["version"]) == ("in-doubt", "drift-check", 2)
    assert shown["reason"]["values"]["shift_mm"] == pytest.approx(20, abs=2)
    refused(run("export", "--to", "opencv", cwd=folder), 1, "calibration-in-doubt")
    with raises("calibration-in-doubt", InstallError):
        load_installed(folder / "state/calibration-station")
    withdrawn = run("withdraw", "a pallet hit the camera", "--json", cwd=folder)
    assert json.loads(withdrawn.stdout)["state"] == "withdrawn"
    refused(run("withdraw", "xxx", cwd=folder), 1, "reason-too-short")


@pytest.mark.parametrize(
    "step", ["calibrate.cli.drift_check.check_drift", "calibrate.files.calibration.read_bounded"]
)
def test_a_check_judges_the_calibration_that_it_was_made_on(
    real_session_file: Path, real_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """Another one is installed while the board is looked for, or when the installed one was just read."""
    install(real_file, root := tmp_path / "cell")
    do = pkgutil.resolve_name(step)

    def meanwhile(*given: object) -> object:
        done = do(*given)
        monkeypatch.setattr(step, do)
        install(real_file, root)
        return done

    monkeypatch.setattr(step, meanwhile)
    monkeypatch.setattr("calibrate.cli.drift_check._is_origin", lambda *_: False)
    refused(run("drift-check", real_session_file, "--root", root, cwd=tmp_path), 1, "other-version")
    assert load_installed(root).validity.state is ValidityState.VALID


def test_a_touch_test_does_not_begin_the_trend_anew(real_file: Path, tmp_path: Path) -> None:
    """It makes another version of the same solve; another solve begins it."""
    install(real_file, root := tmp_path / "cell")
    check = ("--root", root, "--json")
    later = Scene(views=6, seed=17)
    new = write_session(tmp_path / "new.mcap", later, known_lens=True, source="real", name="later")
    told = json.loads(run("drift-check", new, *check, cwd=tmp_path).stdout)
    (first,) = read_checks(root)
    assert not told["trend"] and first.p_value == told["p_value"]
    for week in range(1, 5):
        right = tuple(1e4 * week + value for value in first.right)
        append_check(msgspec.structs.replace(first, wall_s=first.wall_s - 6e5 * week, right=right), root)
    touch = Touch(0, (0.0, 0.0), (0.1, 0.0), (0.1, 0.1), "told by a person", "anna", "2026-01-01")
    note_installed(root, read_calibration(real_file), [touch])
    assert json.loads(run("drift-check", new, *check, cwd=tmp_path).stdout)["trend"]
    anew = msgspec.structs.replace(read_calibration(real_file), created="2026-01-02T00:00:00+00:00")
    write_calibration(anew, tmp_path / "anew.yaml")
    install(tmp_path / "anew.yaml", root)
    assert not json.loads(run("drift-check", new, *check, cwd=tmp_path).stdout)["trend"]


@pytest.mark.parametrize("lost", ["checks.jsonl", "validity.jsonl"])
def test_a_check_is_told_though_it_cannot_be_noted(
    real_session_file: Path, real_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lost: str
) -> None:
    """A disk that takes no log must not hide that the camera moved."""
    moved = shifted(read_calibration(real_file), 0.02)
    write_calibration(msgspec.structs.replace(moved, posterior=None), tmp_path / "moved.yaml")
    install(tmp_path / "moved.yaml", root := tmp_path / "cell")
    monkeypatch.setattr("calibrate.cli.drift_check._is_origin", lambda *_: False)
    write = lines.open_regular

    def full(path: Path, flags: int = 0) -> int:
        if path.name == lost and flags:
            raise OSError(28, "No space left on device")
        return write(path, flags)

    for module in (lines, validity_writer):
        monkeypatch.setattr(module, "open_regular", full)
    done = run("drift-check", real_session_file, "--root", root, "--json", cwd=tmp_path)
    answer = json.loads(done.stdout)
    assert (done.returncode, answer["passed"]) == (4, False) and "No space left" in done.stderr
    judged = load_installed(root, require_valid=False).validity.state
    assert (judged is ValidityState.VALID) == (lost == "validity.jsonl")


@pytest.mark.parametrize(("device", "elsewhere"), [("robot", False), ("camera", False), ("robot", True)])
def test_a_session_of_this_cell_with_another_device_puts_what_is_installed_in_doubt(
    real_file: Path, tmp_path: Path, device: str, elsewhere: bool
) -> None:
    root = tmp_path / "cell"
    install(real_file, root)
    folder = tmp_path / "elsewhere" if elsewhere else root / "sessions" / "later"
    folder.mkdir(parents=True)
    other = {
        "robot": {"robot": RobotIdentity("UR10", "other")},
        "camera": {"camera_identity": CameraIdentity("rendered", "MER", "other")},
    }
    recording = write_session(
        folder / "later.mcap", Scene(views=3, seed=7), known_lens=True, source="real",
        created_wall_ns=1_800_000_000_000_000_000, **other[device],
    )  # fmt: skip
    answer = run("drift-check", recording, "--root", root, "--json", cwd=tmp_path)
    told = json.loads(answer.stdout)["error"]
    assert (answer.returncode, told["code"], told["values"]["differs"]) == (
        2,
        "views-of-another-cell",
        device,
    )
    validity = load_installed(root, require_valid=False).validity
    if elsewhere:
        assert validity.state is ValidityState.VALID
        return
    assert (validity.state, validity.reason.code) == (ValidityState.IN_DOUBT, f"{device}-changed")
    assert validity.reason.values["found"] == "other"


def test_simulated_never_installs_on_a_real_cell(small_session_file: Path, tmp_path: Path) -> None:
    shutil.copy(small_session_file, tmp_path)
    run("solve", ".", cwd=tmp_path)
    made = f"{tmp_path.name}.calibration.yaml"
    (tmp_path / "newest").symlink_to(tmp_path)
    assert "newest.calibration.yaml" in run("solve", "newest", cwd=tmp_path).stdout
    refused(run("install", made, "--override", "x", cwd=tmp_path), 1, "other-cell")
    refused(run("install", made, "--cell", "simulated", cwd=tmp_path), 2, "root-missing", "--root")
    assert not list((tmp_path / "state").rglob("*.yaml")), "the real cell's place is untouched"


@pytest.mark.process
def test_the_same_bits_in_two_processes(session_file: Path, tmp_path: Path) -> None:
    """Whatever the threads; the lens is found from the pictures too. Only the date may differ."""
    for threads, name in (("1", "a.yaml"), ("3", "b.yaml")):
        words = ["solve", str(session_file), "-o", str(tmp_path / name), "--threads", threads]
        command = [sys.executable, "-m", "calibrate.cli", *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode in (0, 4), done.stderr
    first, second = ((tmp_path / name).read_text().splitlines() for name in ("a.yaml", "b.yaml"))
    different = [a for a, b in zip(first, second, strict=True) if a != b]
    assert all(line.startswith("created:") for line in different), different


def test_names_are_printed_as_they_are(real_file: Path, tmp_path: Path) -> None:
    """Brackets and colons are no markup: the command that is offered next must work as it stands."""
    name = "c[red]:bug:.yaml"
    shutil.copy(real_file, tmp_path / name)
    assert name in run("install", name, "--cell", "simulated", "--root", "r", cwd=tmp_path).stderr
    board = run("board", "-o", "b[a]:bug:.pdf", cwd=tmp_path)
    assert "b[a]:bug:.pdf (" in board.stdout


def test_bytes_that_are_no_utf_8_are_one_line(
    real_file: Path, make_file, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOGNAME", os.fsdecode(b"anna\xff"))
    assert run("install", real_file, cwd=tmp_path).returncode == 0
    missed = Touch(0, (0.0, 0.0), (5.0, 0.0), (0.1, 0.1), "told by a person", "anna", "2026-01-01")
    failed = make_file(verification=[missed])
    for command in (["withdraw"], ["rollback", "1", "--reason"], ["install", failed, "--override"]):
        refused(run(*command, os.fsdecode(b"knocked over \xff"), cwd=tmp_path), 1, "not-utf-8")
    listed = json.loads(run("list", "--json", cwd=tmp_path).stdout)
    assert [row["validity"]["state"] for row in listed] == ["valid"]


def test_the_board_prints(tmp_path: Path) -> None:
    done = run("board", "-o", "b.pdf", "--paper", "A4", cwd=tmp_path)
    assert done.returncode == 0
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF-")
    warned = run("board", "11x9 25", "-o", "b.svg", cwd=tmp_path)
    assert warned.stderr, "it looks the same when turned by 180°"
    tag = run("board", "april-tag 120 3", "-o", "b.svg", cwd=tmp_path)
    assert "april-tag 3 of DICT_APRILTAG_36h11, 120 mm" in tag.stdout
    assert run("board", "-o", "b.ppm", cwd=tmp_path).returncode == 0
    assert (tmp_path / "b.ppm").read_bytes().startswith(b"P6\n1000 900\n255\n")
    refused(run("board", "-o", "b.bmp", cwd=tmp_path), 2, "board-format")


def test_batch_solves_the_rest_and_goes_on_where_it_was(small_session_file: Path, tmp_path: Path) -> None:
    recordings = [shutil.copy(small_session_file, tmp_path / f"r{k}.mcap") for k in range(2)]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(small_session_file.read_bytes()[:-5000])
    done = run("batch", *recordings, cut, "gone", "lost", "-o", "out", "--json", cwd=tmp_path)
    assert done.returncode == 3, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["solved"] for row in rows] == [True, True, False, False, False]
    assert [Path(row["recording"]).name for row in rows[2:]] == ["cut.mcap", "gone", "lost"]
    assert rows[0]["result"] == rows[1]["result"] and rows[0]["sigma"]
    before = (tmp_path / "out/results.jsonl").read_text().splitlines()
    again = run("batch", *recordings, "-o", "out", "--json", cwd=tmp_path)
    assert again.returncode == 0
    assert (tmp_path / "out/results.jsonl").read_text().splitlines() == before


def test_the_report_is_one_page_with_no_network(small_session_file: Path, tmp_path: Path) -> None:
    done = run("solve", small_session_file, "-o", "c.yaml", "--report", "r.html", cwd=tmp_path)
    assert done.returncode in (0, 4), done.stderr
    page = (tmp_path / "r.html").read_text()
    body = page.replace("http://www.w3.org/", "")
    assert "http://" not in body.replace("http://purl.org/", "").replace("http://creativecommons.org/", "")
    assert "https://" not in body
    assert "<script" not in body
    first = page.index('class="verdict')
    assert first < page.index("Gates")
    assert "SIMULATED" in page[: first + 200]
    assert page.count("data:image/jpeg") == 1 + 5
    assert page.count("<summary>") >= 6


def test_numbers_to_paste_from_the_command_line(real_file: Path, tmp_path: Path) -> None:
    done = run("export", real_file, "--as", "kuka-abc", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].startswith("{X ")
    assert run("export", real_file, "--as", "ur-rotvec", "-o", "x.txt", cwd=tmp_path).returncode == 0
    assert (tmp_path / "x.txt").read_text().splitlines()[-1].startswith("p[")
    refused(run("export", real_file, "--as", "kuka", cwd=tmp_path), 1, "no-convention")
    refused(run("export", real_file, cwd=tmp_path), 2, "options")
    refused(run("export", real_file, "--as", "kuka-abc", "--to", "zivid", cwd=tmp_path), 2, "options")
    given = run("export", real_file, "--as", "kuka-abc", "--arm", real_file, cwd=tmp_path)
    refused(given, 2, "arm-of-urdf")
