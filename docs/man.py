"""Prints the manual page of a command line from its help: `python docs/man.py station > station.1`."""

from __future__ import annotations

import importlib
import inspect
import runpy
import sys
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from recordings.cli.lazy import LazyGroup

CLI = runpy.run_path(str(Path(__file__).with_name("cli.py")))
"""What docs/reference/cli.md is made of."""


def page(program: str) -> str:
    group: LazyGroup = getattr(importlib.import_module(f"{program}.cli.app"), CLI["GROUPS"][program])
    lines = [
        f'.TH {program.upper()} 1 "" "calibration-station {version("calibration-station")}"',
        ".SH NAME",
        _text(f"{program} - {(group.help or '').splitlines()[0]}"),
        ".SH SYNOPSIS",
        f".B {program}",
        "COMMAND [OPTIONS]",
        ".SH COMMANDS",
    ]
    for name in group.commands:
        lines += _command(program, name, group.resolve_command(None, [name])[1])
    lines += [".SH FILES", *_named(group.files), ".SH ENVIRONMENT", *_named(group.environment)]
    lines += [".SH EXIT STATUS", _text((group.epilog or "").rpartition("\n\n")[2])]
    others = ", ".join(rf"\fB{other}\fR(1)" for other in CLI["GROUPS"] if other != program)
    return "\n".join([*lines, ".SH SEE ALSO", others]) + "\n"


def _command(program: str, name: str, command: Any) -> Iterator[str]:
    """Yield a command: what it does, its options with their defaults, and examples."""
    yield f".SS {program} {_text(name)}"
    yield _text(inspect.cleandoc(command.help or ""))
    for option in CLI["options"](command):
        yield from _item(", ".join((*option.opts, *option.secondary_opts)), _said(option))
    if examples := CLI["examples"](command):
        yield from (".PP", "Examples:", ".RS 4", ".nf", *map(_text, examples), ".fi", ".RE")


def _said(option: Any) -> str:
    """Write what an option does, and its default."""
    said = " ".join((getattr(option, "help", "") or "").split()).rstrip(".")
    given = CLI["default"](option)
    return f"{said}. Default: {given}." if given else f"{said}."


def _named(table: Mapping[str, str]) -> Iterator[str]:
    for name, what in table.items():
        yield from _item(name, what)


def _item(name: str, what: str) -> Iterator[str]:
    """Yield a name, and what it is below it."""
    yield from (".TP", f".B {_text(name)}", _text(what))


def _text(said: str) -> str:
    """Plain text as roff takes it."""
    lines = said.replace("\\", "\\e").replace("-", "\\-").replace("`", "").splitlines()
    return "\n".join("\\&" + line if line.startswith((".", "'")) else line for line in lines)


if __name__ == "__main__":
    print(page(sys.argv[1]), end="")
