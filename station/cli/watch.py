"""`station watch`: notice through the station's own camera that camera, tag or arm moved."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from itertools import count, islice
from pathlib import Path
from typing import Annotated

import typer

from calibrate.cli.files import read_board
from calibrate.cli.watch import AsLines, Watched, WatchSource, WatchSourceError, watch_pictures
from calibrate.files.calibration import Calibration
from calibrate.quality.drift import CellIdentity, require_same_cell
from calibrate.quality.movement.log import WatchEntry
from recordings.schema.messages import BoardSpec
from station.cell.errors import StationError
from station.cell.socket_folder import default_socket
from station.cli.console import Socket, err
from station.protocol.client import Client, ask
from station.protocol.verbs import Configuration, Observation, Observe

_LATER = {"wrong-state", "arm-moves", "moved-in-exposure"}
"""Refusals that belong to production: a session runs, or the arm is on its way."""


def watch_command(
    board: Annotated[
        Path | None, typer.Option(help="YAML of the tag (default: the configuration's board)")
    ] = None,
    every: Annotated[float, typer.Option(min=0.2, help="Seconds between two looks")] = 60.0,
    images: Annotated[int | None, typer.Option(min=1, help="End after so many (default: at Ctrl-C)")] = None,
    socket: Socket = None,
    as_json: AsLines = False,
) -> None:
    """Notice through the station's own camera that camera, tag or arm moved.

    As `calibrate watch`, with images of the daemon's camera: every minute, one of each stop of the arm,
    whatever program moves it, while no session runs. The station adds no motion, and no control is needed.
    What is tested, and put in doubt, is what is installed in the daemon's state folder.

    Exit codes: 0 nothing moved so far, 4 something moved, 1 unusable or nothing installed, 2 wrong options.
    """
    path = socket or default_socket()
    root, camera, own_board = asyncio.run(_cell(path))
    watched = Watched.find(None, root, camera)
    tag = own_board if board is None else read_board(board)
    taking = _Taking(path, watched.calibration, every, images)
    watch_pictures([WatchSource(tag, taking.entries)], tag, watched, as_json)


async def _cell(path: Path) -> tuple[Path | None, str, BoardSpec]:
    """State folder, camera and board of the daemon. Raises StationError."""
    async with Client(path) as client:
        return client.root, client.camera, (await client.call(Configuration())).board


class _Taking:
    """Images of the daemon's camera, one every so many seconds."""

    def __init__(self, path: Path, calibration: Calibration, every_s: float, most: int | None) -> None:
        self._path, self._calibration, self._every_s, self._most = path, calibration, every_s, most

    def entries(
        self, tag: BoardSpec, known: Callable[[str], bool], threads: int | None
    ) -> Iterator[tuple[int, int, WatchEntry]]:
        for done, seen in enumerate(islice(self._seen(tag), self._most), 1):
            if done == 1:
                self._require_fit(seen)
            yield done, self._most or done, _entry(seen)

    def _seen(self, tag: BoardSpec) -> Iterator[Observation]:
        """One of each stop of the arm: within a stop its error of repetition is the same.

        Without end. Raises StationError when there is none at first; later it is said, once.
        """
        told, latest_ns = "", 0
        for number in count():
            if number:
                time.sleep(self._every_s)
            try:
                seen = ask(self._path, Observe(tag))
            except StationError as problem:
                if problem.code not in _LATER | {told}:
                    if not number:
                        raise
                    told = problem.code
                    err.print(f"No image: {problem}", style="yellow")
                continue
            told = ""
            if seen.wall_ns - round(1e9 * seen.rested_s) > latest_ns:
                latest_ns = seen.wall_ns
                yield seen

    def _require_fit(self, seen: Observation) -> None:
        """Raise OtherCellError, WatchSourceError where this is not the calibration's cell and image size."""
        identity = CellIdentity(seen.mount, seen.source, seen.robot_serial, seen.camera_serial)
        require_same_cell("The station", self._calibration, identity)
        lens = self._calibration.intrinsics
        if (seen.width, seen.height) != (lens.width, lens.height):
            why = f"the camera's images are {seen.width}×{seen.height}, the calibration is of "
            raise WatchSourceError(why=why + f"{lens.width}×{lens.height}", advice="")


def _entry(seen: Observation) -> WatchEntry:
    when = datetime.fromtimestamp(seen.wall_ns / 1e9).isoformat(sep=" ", timespec="milliseconds")
    return WatchEntry(
        None,
        f"station/{seen.camera_serial}/{seen.wall_ns}",
        when,
        seen.wall_ns / 1e9,
        seen.base_from_flange,
        seen.joints_rad,
        seen.corners,
        seen.pixels,
    )
