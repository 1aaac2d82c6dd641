"""Every command's help ends with examples; the parser takes them, and the commands in the documents."""

from __future__ import annotations

import re
import shlex

import pytest
import typer

from calibrate.cli.app import CALIBRATE
from recordings.cli.app import RECORDINGS
from station.cli.app import STATION

PROGRAMS = {
    "calibrate": CALIBRATE,
    "recordings": RECORDINGS,
    "station": STATION,
}
COMMANDS = [(program, name) for program, group in PROGRAMS.items() for name in group.commands]


def examples_in(epilog: str | None) -> list[str]:
    return re.findall(r"^- `(.+)`$", epilog or "", re.MULTILINE)


def parse(line: str) -> str:
    """The command's name. Raises click's UsageError; nothing is run."""
    program, *words = shlex.split(line.partition(" > ")[0], comments=True)
    if not words:
        return ""
    group = PROGRAMS[program]
    name, command, rest = group.resolve_command(typer.Context(group), words)
    command.make_context(name, rest)
    return str(name)


@pytest.mark.parametrize(("program", "name"), COMMANDS)
def test_every_command_ends_its_help_with_examples_that_parse(program: str, name: str) -> None:
    group = PROGRAMS[program]
    command = group.resolve_command(typer.Context(group), [name])[1]
    given = examples_in(command.epilog)
    assert given
    for line in (line.rpartition(" | ")[2] for line in given):
        assert line.startswith(f"{program} ")
        assert parse(line) == name


def commands_in(text: str) -> list[str]:
    """Lines of code blocks that are one whole command: not those with `…`, `[…]` or `a|b` in them.

    Two spaces and more part a command from what is said of it.
    """
    fenced = "\n".join(re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL))
    indented = "\n".join(line for line in text.splitlines() if line.startswith("    "))
    lines = [re.split(r"\s{2,}", line.strip())[0] for line in (fenced + indented).splitlines()]
    return [
        line
        for line in lines
        if re.match(rf"({'|'.join(PROGRAMS)})( |$)", line) and not re.search(r"[…\[|]|\.\.\.", line)
    ]
