"""Consoles and options of all commands: results go to stdout, everything else to stderr."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from recordings.cli.console import AsJson as AsJson
from recordings.cli.console import OpenReport as OpenReport
from recordings.cli.console import open_report as open_report
from recordings.cli.console import plain_console
from recordings.cli.console import print_json as print_json
from station.cell.errors import StationError

# What stands out does so by `style` or a Text.
out = plain_console(soft_wrap=True)
err = plain_console(stderr=True, soft_wrap=True)

Socket = Annotated[Path | None, typer.Option(help="The daemon's control socket.")]
Headless = Annotated[bool, typer.Option("--headless", help="Never prompt, no progress bar")]


def require_terminal(what: str, advice: str) -> None:
    """Raise StationError (`no-terminal`) where no person reads and types."""
    if not sys.stdout.isatty() or not sys.stdin.isatty():
        raise StationError("no-terminal", what=what, advice=advice)
