"""The shell's contract: exit codes, one JSON object, errors in words; and the daemon behind it."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import pytest
import typer

from recordings.errors import CodedError, ErrorReport
from station.cell.errors import StationError
from station.cell.status import MotionPreview, PoseStatus, SessionStatus, StationState, StationStatus
from station.cli import daemon, main, session
from station.cli.app import STATION
from station.cli.daemon import ensure_daemon, own_daemon, tell_what_goes_on
from station.cli.requests import PoseJson, QuitJson, StateJson, StopJson
from station.protocol.client import DaemonGoneError
from station.protocol.states import RUNNING
from tests.codes import raises
from tests.command_line import call
from tests.patience import PATIENCE_S, wait_until
from tests.tui.conftest import FakeLink, idle, in_session

pytestmark = pytest.mark.process

T = TypeVar("T")


class Shell:
    """The command line in this process, beside a daemon that is another."""

    def __init__(self, socket: Path) -> None:
        self.socket = socket

    def __call__(self, *args: str) -> tuple[int, str, str]:
        """Exit code, standard output, standard error."""
        done = call(main, *args)
        return done.returncode, done.stdout, done.stderr

    def ask(self, *args: str) -> tuple[int, str, str]:
        return self(*args, "--socket", str(self.socket))

    def refused(self, *args: str) -> str:
        """The code of what a command fails with."""
        with pytest.raises(CodedError) as problem:
            STATION([*args, "--socket", str(self.socket)], prog_name="station")
        return problem.value.code

    def told(self, command: str, kind: type[T], *args: str) -> T:
        """What a command prints with --json, nothing else on standard output."""
        code, out, err = self.ask(command, *args, "--json")
        assert code == 0, err
        return msgspec.json.decode(out, type=kind)

    def state(self) -> dict[str, Any]:
        state: dict[str, Any] = json.loads(self.ask("status", "--json")[1])
        return state


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    """Beside a simulated daemon, faster than real time."""
    served = ["--simulate", "--scene", "paper-binned", "--root", str(tmp_path), "--time-scale", "4"]
    with own_daemon(served, tmp_path / "daemon.log") as socket:
        yield Shell(socket)


def test_sessions_from_the_shell(shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = tmp_path / "plan.yaml"
    assert shell("plan", "--poses", "4", "-o", str(plan), "--json")[0] == 0

    assert shell.refused("capture", "--plan", str(plan), "--headless", "--approve", "ab" * 32) == "other-plan"

    sha = json.loads(shell("plan", "--check", str(plan), "--json")[1])["approval_sha256"]
    code, out, err = shell.ask("capture", "--plan", str(plan), "--headless", "--approve", sha[:12], "--json")
    assert code in (0, 3), out + err
    result = json.loads(out)
    assert result["poses"]["planned"] == 4
    assert Path(result["recording"]).is_file()

    status = shell.state()
    assert status["state"] == "idle" and status["source"] == "simulated"
    assert "SIMULATED" in shell.ask("status")[1]
    code, out, _ = shell.ask("doctor", "--json")
    assert code == 0 and json.loads(out)["ok"]
    assert shell.refused("pause") == "wrong-state"
    assert shell.told("stop", StopJson).outcome == "rests"
    assert shell.state()["state"] == "stopped"
    assert shell.refused("quit") == "wrong-state"
    assert shell.told("acknowledge", StateJson).state == shell.state()["state"] == "idle"
    assert shell.ask("retake", "9")[0] == 1
    kept = shell.told("retake", PoseJson, "2")
    assert (kept.pose, kept.kept, kept.state) == (2, True, "planned")
    assert shell.state()["session"]["poses"][1]["kept"]
    skipped = shell.told("skip", PoseJson, "2")
    assert (skipped.pose, skipped.kept) == (2, False) and skipped.reason
    assert "kept" not in shell.state()["session"]["poses"][1]

    for key in (signal.SIGINT, signal.SIGTSTP):
        is_stop(shell, plan, key)

    assert shell.told("quit", QuitJson).pid > 0
    assert shell.refused("status") == shell.refused("quit") == "no-daemon"


def is_stop(shell: Shell, plan: Path, key: signal.Signals) -> None:
    """Ctrl-C is STOP, and so is Ctrl-Z, behind which nobody would watch."""
    command = [sys.executable, "-m", "station.cli", "capture", "--plan", str(plan), "--headless"]
    capture = subprocess.Popen(
        [*command, "--socket", str(shell.socket)],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_until(lambda: capture.poll() is not None or shell.state()["state"] in RUNNING)
    capture.send_signal(key)
    said = capture.communicate(timeout=PATIENCE_S)[1]
    assert capture.returncode == 130 and "station acknowledge" in said, said
    status = shell.state()
    assert (status["state"], status["cause"]) == ("stopped", "stop")
    assert shell.ask("acknowledge")[0] == 0
    wait_until(lambda: shell.ask("finish")[0] == 0 or shell.state()["state"] == "idle")


def test_a_session_with_loss_names_what_is_missing_and_ends_with_3(
    capsys: pytest.CaptureFixture[str],
) -> None:
    missed = PoseStatus(1, "p02", state="failed", reason="the board is not seen")
    poses = (PoseStatus(0, "p01", state="done"), missed)
    with pytest.raises(typer.Exit) as end:
        ended = SessionStatus(poses=poses, captured=1, recording="/s/r", folder="/s")
        session._finish(StationStatus(session=ended), False)
    said = capsys.readouterr().out
    assert end.value.exit_code == 3 and f"pose 2. {missed.reason}" in said
    assert "calibrate solve /s/r -o /s/calibration.yaml" in said, "where the screen looks for it"


@pytest.mark.parametrize("headless", [True, False])
async def test_a_paused_session_is_finished_with_loss_only_where_nobody_attends(headless: bool) -> None:
    link, paused = FakeLink(), in_session(idle(StationState.PAUSED), captured=1)
    link.show(paused)

    async def again() -> bool:
        raise AssertionError("it had begun")

    await session.Attended(Path(), link, True, headless, "", True).watch(True, paused, again)
    assert link.verbs == ["finish"] * headless


async def test_ctrl_c_without_an_answer_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    class Hanging:
        async def call(self, verb: object, *, timeout_s: float) -> None:
            raise StationError("request-unanswered", verb="stop", timeout_s=timeout_s)

    await session.stop_and_say(Hanging())
    said = capsys.readouterr().err
    assert "emergency stop" in said


def test_ctrl_c_at_the_question_is_a_no_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def pressed(*_: object, **__: object) -> bool:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise typer.Abort from None
        return True

    summary = MotionPreview("t", "run plan", "ab" * 32, 4, 1.0, 0.5, 0.2, 30.0, "84 mm and 22° to pose 1")
    monkeypatch.setattr(typer, "confirm", pressed)

    async def ask() -> bool:  # below an event loop's own handler of Ctrl-C
        return session.ask_person(summary)

    before = signal.getsignal(signal.SIGINT)
    assert asyncio.run(ask()) is False
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("args", "exit_code", "code"),
    [
        (("serve",), 2, "usage"),
        (("serve", "--config", "absent.yaml"), 2, "unreadable-config"),
        (("status", "--socket", "/nowhere/s"), 1, "no-daemon"),
        (("capture", "--plan", "absent.yaml"), 2, "unreadable-plan"),
        (("tui",), 1, "no-terminal"),
        (("demo", "--out", __file__), 2, "not-a-folder"),
    ],
)
def test_what_a_person_can_cause_has_a_code(args: tuple[str, ...], exit_code: int, code: str) -> None:
    with pytest.raises(CodedError) as problem:
        STATION(list(args), prog_name="station")
    assert (problem.value.exit_code, problem.value.code) == (exit_code, code)


@pytest.mark.parametrize(
    "args",
    [
        ("dance",),
        ("retake", "0"),
        ("capture", "--frobnicate"),
        ("demo", "--scene", "moon"),
        ("demo", "--seed", "-1"),
    ],
)
def test_wrong_usage_ends_with_2_and_nothing_on_stdout(args: tuple[str, ...]) -> None:
    done = call(main, *args)
    assert (done.returncode, done.stdout) == (2, "") and done.stderr


def test_a_failure_is_one_json_object_too() -> None:
    done = call(main, "status", "--socket", "/nowhere/s", "--json")
    assert done.returncode == 1 and done.stderr
    assert msgspec.json.decode(done.stdout, type=ErrorReport).error.code == "no-daemon"


def test_a_folder_that_cannot_be_made_is_named() -> None:
    done = call(main, "serve", "--simulate", "--root", __file__)
    assert done.returncode == 1 and __file__ in done.stderr and done.stdout == ""


def test_a_configuration_that_is_named_is_never_replaced_by_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATION_CONFIG", str(tmp_path / "typo.yaml"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with raises("not-started") as problem:
        ensure_daemon(tmp_path / "c.sock")
    assert "typo.yaml" in str(problem.value)


def test_no_second_daemon_is_started_where_one_serves_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(path: Path, verb: object) -> None:
        raise DaemonGoneError("not-allowed", path=path)

    monkeypatch.setattr(daemon, "ask", refused)
    with raises("not-allowed"):
        ensure_daemon(tmp_path / "c.sock")


def test_closing_the_screen_tells_what_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "control.sock"
    tell_what_goes_on(path)
    assert capsys.readouterr().out == ""  # none serves there
    with socket.socket(socket.AF_UNIX) as served:
        served.bind(str(path))
        served.listen()
        tell_what_goes_on(path)
    assert f"`station quit --socket {path}`" in capsys.readouterr().out
