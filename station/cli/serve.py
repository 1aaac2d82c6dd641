"""`station serve`, and starting a daemon for a screen that finds none."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import struct
import subprocess
import sys
import time
from pathlib import Path
from socket import AF_UNIX, SO_PEERCRED, SOL_SOCKET
from socket import socket as connection
from typing import Annotated, get_args

import typer

from recordings.schema.messages import Mount
from station.cell.errors import ConfigError, StationError
from station.cell.priority import DAEMON_NICENESS, go_before_others
from station.cell.session_folder import default_root
from station.cell.socket_folder import default_socket
from station.devices.cell import Cell
from station.protocol.client import DaemonGoneError, ask
from station.simulation.cell import NoiseLevel, SceneName

START_WAIT_S = 30.0
_RANGES = {"scene": SceneName, "noise": NoiseLevel, "mount": Mount}


def serve_command(
    config: Annotated[Path | None, typer.Option(help="The cell's configuration.")] = None,
    simulate: Annotated[bool, typer.Option("--simulate", help="A simulated cell, marked so.")] = False,
    replay: Annotated[Path | None, typer.Option(help="Play this recording as a cell.")] = None,
    socket: Annotated[
        Path | None, typer.Option(help="Where to listen; the default is told when it is ready.")
    ] = None,
    root: Annotated[Path | None, typer.Option(help="State folder: sessions, calibrations.")] = None,
    seed: Annotated[int, typer.Option(help="Simulated: another mount, board place, lens, noise.")] = 0,
    scene: Annotated[str, typer.Option(help="Simulated: paper, blog or paper-binned.")] = "paper",
    noise: Annotated[str, typer.Option(help="Simulated: low, mid or high.")] = "low",
    mount: Annotated[str, typer.Option(help="Simulated: eye-in-hand or eye-to-hand.")] = "eye-in-hand",
    gige: Annotated[
        bool, typer.Option("--gige", help="Simulated: the camera over GigE Vision packets.")
    ] = False,
    hardware_trigger: Annotated[
        bool, typer.Option("--hardware-trigger", help="Simulated: a trigger box fires the camera.")
    ] = False,
    frame_rate_hz: Annotated[float, typer.Option(hidden=True)] = 0.0,
    robot: Annotated[str, typer.Option(hidden=True)] = "UR10",
    time_scale: Annotated[float, typer.Option(hidden=True)] = 1.0,
    end_with_stdin: Annotated[bool, typer.Option("--end-with-stdin", hidden=True)] = False,
) -> None:
    """Own the cell and serve it on a Unix socket. Nothing moves without a person's go.

    It runs until Ctrl-C (or SIGTERM): that stops the arm, seals what is recorded, and ends.
    """
    if [simulate, config is not None, replay is not None].count(True) != 1:
        raise ConfigError(
            "say what to serve, one of: --config FILE (a real cell), --simulate, --replay RECORDING"
        )
    require_choices(scene=scene, noise=noise, mount=mount)
    logging.basicConfig(level=logging.INFO, format=_log_format(), stream=sys.stderr)
    place = root or default_root()
    # What only one kind of cell needs is loaded only for it.
    if config is not None:
        cell = _real_cell(config, place)
    elif replay is not None:
        from station.devices.playback_cell import playback_cell

        cell = playback_cell(replay)
    else:
        from station.simulation.launch_cell import SimulationOptions, simulated_cell

        options = SimulationOptions(
            scene,  # type: ignore[arg-type]
            seed,
            noise,  # type: ignore[arg-type]
            mount,  # type: ignore[arg-type]
            time_scale,
            gige,
            hardware_trigger,
            frame_rate_hz,
            robot,
        )
        cell = simulated_cell(options, place / "simulation")
    asyncio.run(serve_cell(cell, place, socket or default_socket(), end_with_stdin))


def require_choices(**chosen: str) -> None:
    """ConfigError for a word that is not one of the offered ones."""
    for name, word in chosen.items():
        if word not in (known := get_args(_RANGES[name])):
            raise ConfigError(f"--{name} {word}: choose one of {', '.join(known)}")


def _real_cell(config: Path, root: Path) -> Cell:
    from station.cell.config_file import load_config
    from station.devices.factory import configured_cell

    loaded, text = load_config(config)
    return configured_cell(loaded, text, root)


async def serve_cell(cell: Cell, root: Path, socket: Path, end_with_stdin: bool) -> None:
    from station.daemon import Daemon

    go_before_others(DAEMON_NICENESS)
    try:
        daemon = Daemon(cell, root, socket)
        if end_with_stdin:
            loop = asyncio.get_running_loop()
            loop.add_reader(sys.stdin.fileno(), lambda: None if os.read(0, 4096) else daemon.end())
        await daemon.run(lambda: print(json.dumps({"ready": True, "socket": str(socket)}), flush=True))
    finally:
        cell.ended()


def _log_format() -> str:
    """The journal has its own clock."""
    stamp = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "
    return f"{stamp}%(levelname)s %(name)s: %(message)s"


def find_config() -> Path | None:
    """$STATION_CONFIG, the user's, or the system's; None where there is none."""
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    places = [home / "calibration-station" / "station.yaml", Path("/etc/station/station.yaml")]
    if named := os.environ.get("STATION_CONFIG"):
        places.insert(0, Path(named))
    return next((place for place in places if place.is_file()), None)


def ensure_daemon(socket: Path) -> Path:
    """The socket of a daemon that answers; starts one where none does. StationError when that fails."""
    if _answers(socket):
        return socket
    root = default_root()
    config = find_config()
    what = ["--simulate"] if config is None else ["--config", str(config)]
    cell = "a SIMULATED cell (no configuration found)" if config is None else f"the cell of {config}"
    print(f"no daemon serves {socket}: starting one for {cell} …", file=sys.stderr)
    root.mkdir(parents=True, exist_ok=True)
    log = root / "daemon.log"
    with log.open("ab") as words:
        child = subprocess.Popen(
            [sys.executable, "-m", "station.cli", "serve", *what, "--socket", str(socket)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=words,
            start_new_session=True,
        )
    give_up_s = time.monotonic() + START_WAIT_S
    while time.monotonic() < give_up_s and child.poll() is None:
        if _answers(socket):
            return socket
        time.sleep(0.2)
    tail = "\n".join(log.read_text(errors="replace").splitlines()[-3:])
    raise StationError(f"the daemon did not start; {log} ends with:\n{tail}")


def tell_what_goes_on(socket: Path) -> None:
    """Who closed the screen is told that the daemon has not ended, and how to end it."""
    with connection(AF_UNIX) as link:
        try:
            link.connect(str(socket))
        except OSError:
            return
        credentials = link.getsockopt(SOL_SOCKET, SO_PEERCRED, struct.calcsize("3i"))
    pid, user, _ = struct.unpack("3i", credentials)
    own = pid and user == os.getuid()
    ends = f"; `kill {pid}` ends it: the arm stops first, and what is recorded is sealed" if own else ""
    print(f"The station goes on without this screen. `station` opens it again{ends}.")


def _answers(socket: Path) -> bool:
    try:
        ask(socket, "plan")
    except DaemonGoneError:
        return False
    except StationError:
        return True
    return True
