"""The command table: light, and true to the commands."""

from __future__ import annotations

import importlib
from typing import Any

import pytest
import typer

from calibrate.cli.app import CALIBRATE
from recordings.cli.app import RECORDINGS
from recordings.cli.lazy import LazyGroup
from station.cli.app import STATION
from tests.command_line import call

GROUPS = (STATION, CALIBRATE, RECORDINGS)


def resolve(group: LazyGroup, *words: str) -> tuple[str, Any, list[str]]:
    name, command, rest = group.resolve_command(typer.Context(group), list(words))
    return name, command, rest


@pytest.mark.parametrize(("group", "name"), [(group, name) for group in GROUPS for name in group.commands])
def test_a_line_of_the_table_opens_its_commands_help(group: LazyGroup, name: str) -> None:
    line = group.get_command(typer.Context(group), name).help
    assert line == resolve(group, name)[1].help.splitlines()[0]
    assert 0 < len(line) <= 72


@pytest.mark.parametrize("program", ["station", "calibrate", "recordings"])
def test_help_fits_on_a_small_terminal_and_all_lists_every_command(
    program: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    main = importlib.import_module(f"{program}.cli").main
    shown = {option: call(main, option).stdout.splitlines() for option in ("--help", "--all")}
    group: LazyGroup = getattr(importlib.import_module(f"{program}.cli.app"), program.upper())
    common = {name for name, command in group._lazy.items() if not command.rare}
    for option, names in (("--help", common), ("--all", set(group.commands))):
        assert {line.split()[1] for line in shown[option] if line.startswith("│")} >= names
    assert len(shown["--help"]) < 24
    assert not any(f"│ {name} " in line for name in set(group.commands) - common for line in shown["--help"])
