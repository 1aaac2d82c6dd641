"""`station serve`: the daemon of a real, simulated or replayed cell."""

from __future__ import annotations

import asyncio
import faulthandler
import json
import logging
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import util
from pathlib import Path
from typing import Annotated

import typer

from recordings.files import state_root
from station.cell.errors import ConfigError
from station.cell.process import DAEMON_NICENESS, RealTimeThreads, go_before_others
from station.cell.socket_folder import default_socket
from station.cli.simulated import GigE, Mounting, Noise, Scene, Seed
from station.devices.cell import Cell

END_S = 4.7
"""The arm stands and the recording is finished long before, unless the disk hangs."""


def serve_command(
    config: Annotated[Path | None, typer.Option(help="The cell's configuration")] = None,
    rehearse: Annotated[
        bool, typer.Option("--rehearse", help="Simulate the devices of --config; connect to none of them")
    ] = False,
    simulate: Annotated[bool, typer.Option("--simulate", help="A simulated cell, marked so")] = False,
    replay: Annotated[Path | None, typer.Option(help="Play this recording as a cell")] = None,
    socket: Annotated[
        Path | None, typer.Option(help="Where to listen; the default is told when it is ready")
    ] = None,
    root: Annotated[Path | None, typer.Option(help="State folder: sessions, calibrations")] = None,
    seed: Seed = 0,
    scene: Scene = "paper",
    noise: Noise = "low",
    mount: Mounting = "eye-in-hand",
    gige: GigE = False,
    time_scale: Annotated[float, typer.Option(hidden=True)] = 1.0,
    end_with_stdin: Annotated[bool, typer.Option("--end-with-stdin", hidden=True)] = False,
) -> None:
    """Run the daemon that owns a real, simulated or replayed cell.

    Nothing moves without a person's approval. Runs until Ctrl-C or SIGTERM, which stop the arm, finish the
    recording, and end the daemon.

    With --rehearse the configuration's limits, guesses, board and plan are used with a simulated arm and a
    rendered camera, marked SIMULATED. What it makes lies in `rehearsal` below the state folder.
    """
    if [simulate, config is not None, replay is not None].count(True) != 1 or (rehearse and config is None):
        advice = (
            "Give one of --config FILE (a real cell; --rehearse: simulated), --simulate, --replay RECORDING."
        )
        raise ConfigError("usage", problem="Missing the cell to serve", advice=advice)
    log_to_stderr()
    go_before_others(DAEMON_NICENESS)
    real_time = RealTimeThreads()  # before a simulated controller is started, which is given the same
    place, control = state_root(root), socket or default_socket()
    # What only one kind of cell needs is loaded only for it.
    if config is not None and rehearse:
        from station.cell.config_file import load_config
        from station.simulation.launch_cell import FOLDER, rehearsed_cell

        place /= FOLDER
        cell = rehearsed_cell(load_config(config)[0], str(config), place / "simulation", control, seed)
    elif config is not None:
        cell = _real_cell(config, place, control)
    elif replay is not None:
        from station.devices.playback import playback_cell

        cell = playback_cell(replay)
    else:
        from station.simulation.cells import cell_config, make_cell
        from station.simulation.launch_cell import simulated_cell

        truth = make_cell(scene, seed, noise, mount)
        cell = simulated_cell(
            truth,
            cell_config(truth),
            place / "simulation",
            time_scale=time_scale,
            gige=gige,
        )
    asyncio.run(serve_cell(cell, place, control, end_with_stdin, real_time))


def _real_cell(config: Path, root: Path, control: Path) -> Cell:
    from station.cell.config_file import load_config
    from station.daemon import configured_cell

    loaded, text = load_config(config)
    return replace(configured_cell(loaded, text, root, control), config_path=str(config.absolute()))


async def serve_cell(
    cell: Cell, root: Path, socket: Path, end_with_stdin: bool, real_time: RealTimeThreads | None = None
) -> None:
    """Ends the process, too: a thread in a driver or on a disk that hangs is not waited for."""
    from station.daemon import Daemon

    try:
        daemon = Daemon(cell, root, socket, _end_in_time, real_time)
        if end_with_stdin:
            at_end_of_input(daemon.end)
        await daemon.run(lambda: print(json.dumps({"ready": True, "socket": str(socket)}), flush=True))
    finally:
        cell.ended()
    logging.shutdown()
    sys.stdout.flush()
    util._run_finalizers(0)  # type: ignore[attr-defined]  # else the worker's semaphores count as leaked
    os._exit(0)


def at_end_of_input(ended: Callable[[], None]) -> None:
    """Call back when standard input ends, as it does when the program that started this one dies."""
    loop = asyncio.get_running_loop()

    def read() -> None:
        if not os.read(0, 4096):
            loop.remove_reader(0)  # its end would be told in every round
            ended()

    loop.add_reader(0, read)


def _end_in_time() -> None:
    """Whatever hangs, the process has ended END_S later, with 1; the log says what each thread was doing."""
    faulthandler.dump_traceback_later(END_S, exit=True)


def log_to_stderr() -> None:
    journal = "JOURNAL_STREAM" in os.environ  # it has a clock of its own
    logging.basicConfig(
        level=logging.INFO, format=f"{'' if journal else '%(asctime)s '}%(levelname)s %(name)s: %(message)s"
    )
