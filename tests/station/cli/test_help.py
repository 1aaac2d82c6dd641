"""The command table: light, true to the commands, and friendly to last release's names."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
import typer

from station.cli.app import STATION


def resolve(*words: str) -> tuple[str, Any, list[str]]:
    name, command, rest = STATION.resolve_command(typer.Context(STATION), list(words))
    return name, command, rest


@pytest.mark.parametrize("name", STATION.commands)
def test_a_line_of_the_table_opens_its_commands_help(name: str) -> None:
    line = STATION.get_command(typer.Context(STATION), name).help
    assert line == resolve(name)[1].help.splitlines()[0]
    assert 0 < len(line) <= 72


def test_a_command_answers_to_its_former_name_too() -> None:
    assert resolve("check")[0] == "drift-check"
    assert "check" not in STATION.commands


@pytest.mark.parametrize("command", ["capture", "resume", "drift-check"])
def test_an_option_answers_to_its_former_name_too(command: str) -> None:
    assert resolve(command, "--go", "ab", "--go=cd", "go")[2] == ["--approve", "ab", "--approve=cd", "go"]


@pytest.mark.parametrize(
    ("argument", "foreign"),
    [
        ("--help", ("numpy", "scipy", "cv2", "textual", "calibrate", "station.operate", "asyncio")),
        ("status", ("numpy", "scipy", "cv2", "textual", "calibrate", "station.simulation", "station.plan")),
        ("capture", ("textual", "gi", "serial", "rtde_control", "station.simulation", "station.session")),
    ],
)
def test_a_command_loads_what_it_needs_alone(argument: str, foreign: tuple[str, ...]) -> None:
    program = (
        f"import sys, station.cli; sys.argv = ['station', {argument!r}, '--help']\n"
        "try: station.cli.main()\n"
        f"except SystemExit: print([m for m in {foreign} if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
