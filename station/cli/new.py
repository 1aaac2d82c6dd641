"""`station new`: set up a cell in a wizard that only reads; then rehearse it, or open it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recordings.files import state_root
from station.cell.socket_folder import default_socket
from station.cli.console import err, require_terminal
from station.cli.daemon import own_daemon, start_daemon, tell_what_goes_on, user_config
from station.devices.guided import RealHardware
from station.operate.cell_setup import CellSetup


def new_command(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The configuration; default: where `station` looks")
    ] = None,
    root: Annotated[Path | None, typer.Option(help="State folder: keeps what was found so far")] = None,
) -> None:
    """Set up a cell in a wizard that only reads.

    Robot, camera, board, four views guided by hand, limits; then it writes a configuration. Your hand
    moves the arm, by the pendant's own Freedrive. Every step can be left and taken up again. For an arm
    that is no UR, type `posted` and its name: a program will post its pose.

    At the end Enter writes the file and opens the cell; F9 rehearses the whole job in simulation first.
    """
    require_terminal("The wizard", "Without one write a configuration: `station doctor --example`.")
    from station.tui.new_cell import run

    place = output or user_config()
    match run(CellSetup(RealHardware(), state_root(root), place.absolute())):
        case "rehearse":
            _rehearse(place, root)
        case "serve":
            _serve(place)


def _serve(config: Path) -> None:
    from station.tui.app import run

    socket = default_socket()
    start_daemon(socket, config)
    run(socket)
    tell_what_goes_on(socket)


def _rehearse(config: Path, root: Path | None) -> None:
    """The rehearsal's own daemon lives as long as its screen."""
    from station.tui.app import run

    what = ["--config", str(config), "--rehearse", *([] if root is None else ["--root", str(root)])]
    err.print(f"Starting the rehearsal of {config}: SIMULATED, nothing real moves …")
    log = state_root(root) / "rehearsal" / "daemon.log"
    with own_daemon(what, log) as socket:
        run(socket)
    err.print(f"The rehearsal has ended. `station new` opens the wizard again; {config} is as it was.")
