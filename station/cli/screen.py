"""`station` and `station tui`: the operator screen, and a daemon for it where none runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from station.cell.errors import StationError
from station.cell.socket_folder import default_socket
from station.cli.console import Socket
from station.cli.daemon import ensure_daemon, tell_what_goes_on


def tui_command(
    socket: Socket = None,
    replay: Annotated[Path | None, typer.Option(help="Play this recording on the live screen")] = None,
) -> None:
    """Open the operator screen; start a daemon if none runs.

    The daemon gets a simulated cell where there is no configuration. With --socket none is started: the
    screen waits for the one that serves there.
    """
    if not sys.stdout.isatty() or not sys.stdin.isatty():
        raise StationError(
            "The operator screen needs a terminal",
            code="no-terminal",
            remedy="Without one use `station capture` or `station demo`.",
        )
    from station.tui.app import run, run_replay

    if replay is not None:
        run_replay(replay)
        return
    # A socket that is named belongs to somebody: on a cell's console a second daemon would be a wrong one.
    served = socket or ensure_daemon(default_socket())
    run(served)
    tell_what_goes_on(served)
