"""Prints the manual page of a command line from its help: `python docs/man.py station > station.1`."""

from __future__ import annotations

import importlib
import inspect
import sys
from importlib.metadata import version

from recordings.cli.lazy import LazyGroup

GROUPS = {"station": "STATION", "calibrate": "CALIBRATE", "recordings": "RECORDINGS"}


def page(program: str) -> str:
    group: LazyGroup = getattr(importlib.import_module(f"{program}.cli.app"), GROUPS[program])
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
        command = group.resolve_command(None, [name])[1]
        lines += [f".SS {program} {name}", _text(inspect.cleandoc(command.help or ""))]
        for option in command.params:
            names = ", ".join(option.opts + option.secondary_opts) or option.name
            lines += [".TP", f".B {_text(names)}", _text(getattr(option, "help", "") or "")]
    return "\n".join([*lines, ".SH EXIT STATUS", _text((group.epilog or "").rpartition("\n\n")[2])]) + "\n"


def _text(said: str) -> str:
    """Plain text as roff takes it."""
    lines = said.replace("\\", "\\e").replace("-", "\\-").replace("`", "").splitlines()
    return "\n".join("\\&" + line if line.startswith((".", "'")) else line for line in lines)


if __name__ == "__main__":
    print(page(sys.argv[1]), end="")
