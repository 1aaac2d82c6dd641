"""The errors of all commands: on stderr, first the name of the command, then what and what to do."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import calibrate.cli
import recordings.cli
import station.cli
from recordings.plain_text import printed
from tests.command_line import call


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (calibrate.cli.main, ("show", "none.yaml")),
        (calibrate.cli.main, ("solve", "none.mcap")),
        (recordings.cli.main, ("info", "none.mcap")),
        (recordings.cli.main, ("recover", "none.mcap")),
        (recordings.cli.main, ("import", "none", "-o", "out.mcap")),
        (station.cli.main, ("status", "--socket", "none")),
        (station.cli.main, ("doctor", "--config", "none.yaml")),
        (station.cli.main, ("plan", "--check", "none.yaml")),
    ],
)
def test_an_error_begins_with_the_name_of_its_command(
    main: Callable[[], None], arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = call(main, *arguments)
    command = main.__module__.partition(".")[0]
    assert done.returncode in (1, 2)
    assert done.stderr.startswith(f"{command}: ") and "none" in done.stderr
    assert not done.stdout and "Traceback" not in done.stderr
    assert not done.stderr.strip().endswith(".")


@pytest.mark.parametrize("main", [calibrate.cli.main, recordings.cli.main, station.cli.main])
def test_help_may_be_asked_for_shortly(main: Callable[[], None]) -> None:
    done = call(main, "-h")
    assert done.returncode == 0 and done.stdout and not done.stderr


def test_a_terminal_without_our_letters_gets_what_it_can_show() -> None:
    latin = {"PATH": "/usr/bin:/bin", "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    asked = [sys.executable, "-m", "station.cli", "plan", "--help"]
    done = subprocess.run(asked, env=latin, capture_output=True)
    assert done.returncode == 0 and done.stdout and not done.stderr


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("x.yaml: no such file.", "x.yaml: no such file"),
        ("what. Do that.", "what. Do that"),
        ("nothing in .", "nothing in ."),
        ("nothing in ..", "nothing in .."),
        ("nothing in a/.", "nothing in a/."),
        ("", ""),
    ],
)
def test_an_error_is_printed_without_a_full_stop_and_a_folder_keeps_its_own(said: str, told: str) -> None:
    assert printed(Exception(said)) == told
