"""`station bootstrap`: from a rough camera pose and a taught view to guesses good enough for a plan."""

from __future__ import annotations

import asyncio
import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
import yaml
from rich.text import Text

from calibrate.geometry import Array
from calibrate.lens.pnp import solve_pnp
from calibrate.load import load_views
from calibrate.views import ViewSet
from recordings.files import ASKED_FOR, write_atomically
from recordings.reader import open_recording
from recordings.schema.messages import Mount, SessionInfo, Vector6
from station.cell.config import PoseGuess, StationConfig
from station.cell.config_file import load_config
from station.cell.errors import ConfigError, LimitError, StationError
from station.cell.plan import Plan, PlannedPose
from station.cell.socket_folder import default_socket
from station.cli.console import Headless, Socket, err, out
from station.cli.session import joints_of, load_into, session
from station.operate.motion import wait_until_idle
from station.plan.bootstrap import MOVES_MAX, MOVES_MIN, BootstrapView, believe, improved_config, next_move
from station.protocol.client import Client
from station.protocol.verbs import Purpose

_SAME_FILE = "Give the configuration that the daemon runs with, or restart the daemon."
_STRAYED_RAD = 0.01
"""Somebody moved the arm: the next move was checked from elsewhere."""
_JOINT_SPEED_RAD_S, _JOINT_ACCELERATION_RAD_S2 = 0.2, 0.5
"""Slow: speed is capped at the modelled camera, and the true one may be 100 mm from there."""


class BootstrapError(StationError):
    """A move or an image of the bootstrap failed; nothing is left running."""

    code = "bootstrap"


def bootstrap_command(
    config: Annotated[Path, typer.Option(help="The configuration that the daemon runs with")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File for the poses that are found (YAML)")
    ] = None,
    headless: Headless = False,
    socket: Socket = None,
) -> None:
    """Find camera pose and board pose by 3 to 5 small moves.

    Each move starts at a taught view and is asked for. Ctrl-C stops the arm.

    First jog the arm to where the camera sees the whole board in the middle of its image: the taught view.
    The configuration holds `camera_guess`, good to about 30° and 100 mm, and `camera.model`.

    Exit codes: 0 good enough for a plan, 3 not yet, 1 refused or failed.
    """
    cell, text = load_config(config)
    if cell.camera.model is None or cell.camera.model.matrix is None:
        raise ConfigError(
            "The bootstrap needs rough intrinsics.",
            code="no-intrinsics",
            remedy="Give camera.model with width, height and a matrix.",
        )
    believe(cell, [])  # says so when there is no camera_guess, before anything is asked
    if output is not None and output.exists():
        raise ConfigError(f"{output} exists.", code="target-exists", remedy="Give another name with -o.")
    glimpses = _make_moves(cell, socket, headless, hashlib.sha256(text).hexdigest())
    found = improved_config(cell, glimpses)
    assert found.camera_guess is not None and found.board_guess is not None
    _show("camera", found.camera_guess)
    _show("board", found.board_guess)
    guesses = {"camera_guess": found.camera_guess, "board_guess": found.board_guess}
    entries = yaml.safe_dump(msgspec.to_builtins(guesses), sort_keys=False)
    if output is None:
        out.print(entries, end="")
    else:
        try:
            write_atomically(output, entries.encode(), ASKED_FOR)
        except OSError as error:
            raise ConfigError(
                f"Cannot write {output}: {error.strerror}. The guesses are:\n{entries}", code="output"
            ) from error
        err.print(f"Put the two entries of {output} into {config}, restart the daemon, then plan.")
    if not believe(cell, glimpses).good:
        err.print(
            "Not certain enough for a good plan: teach another view and repeat with these guesses.",
            style="yellow",
        )
        raise typer.Exit(3)


def _make_moves(
    cell: StationConfig, socket: Path | None, headless: bool, config_sha256: str = ""
) -> list[BootstrapView]:
    """The taught view and those after each move: each a session of its own, with its own approval."""
    path = socket or default_socket()
    taught = asyncio.run(_standing(path, cell.mount))
    move: PlannedPose | None = PlannedPose("taught", taught, why="an image where the arm stands")
    glimpses: list[BootstrapView] = []
    views: ViewSet | None = None
    while move is not None:
        before = glimpses[-1].joints_rad if glimpses else np.array(taught)
        if np.abs(np.array(asyncio.run(_standing(path, cell.mount))) - before).max() > _STRAYED_RAD:
            raise BootstrapError(
                "The arm was moved meanwhile.",
                code="arm-moved",
                remedy="Teach the view again and start over.",
                limit_rad=_STRAYED_RAD,
            )
        of = f" (of {MOVES_MIN} to {MOVES_MAX})" if glimpses else ""
        err.print(Text.assemble((move.name, "bold"), f"{of}: {move.why}"))
        joints, views = _take(cell, move, views, path, headless, config_sha256)
        glimpses = [
            BootstrapView(q, C)
            for q, C in zip(
                [*(g.joints_rad for g in glimpses), joints],
                solve_pnp(views, cell.board).camera_from_board,
                strict=True,
            )
        ]
        belief = believe(cell, glimpses)
        err.print(f"camera pose ± {1000 * belief.sigma_m:.1f} mm, {np.rad2deg(belief.sigma_rad):.2f}°")
        try:
            move = next_move(cell, glimpses)
        except LimitError as error:
            if len(glimpses) == 1:
                raise
            err.print(Text.assemble(("the moves end here", "yellow"), f": {error}"))
            return glimpses
    return glimpses


def _take(
    cell: StationConfig,
    move: PlannedPose,
    before: ViewSet | None,
    socket: Path,
    headless: bool,
    config_sha256: str,
) -> tuple[Array, ViewSet]:
    """One approval, one image: the joints (6,) where it was captured, and all views so far."""
    plan = slow_plan(cell, move)
    outcome = asyncio.run(
        session(socket, Purpose.RUN, headless, before=lambda client: load_into(client, plan))
    )
    if not outcome.session.recording or not outcome.session.captured:
        reason = (outcome.reason or outcome.state.value).rstrip(".")
        raise BootstrapError(
            f"{move.name}: no image was saved ({reason}).",
            code="no-image",
            remedy="Then `station finish` closes what is open; start over from a view of the whole board.",
        )
    recording = open_recording(Path(outcome.session.recording))
    require_same_cell(cell, config_sha256, recording.info)
    loaded = load_views(recording, cell.board, cell.camera.model, fewest=1).views
    [view] = recording.views()
    if view.joints_rad is None or view.name != move.name:
        raise BootstrapError(f"{recording.path} does not hold {move.name}.", code="other-recording")
    if before is None:
        return np.array(view.joints_rad), loaded
    # All views together decide which way round a symmetric board lies.
    return np.array(view.joints_rad), replace(loaded, views=(*before.views, *loaded.views))


def require_same_cell(cell: StationConfig, config_sha256: str, seen: SessionInfo) -> None:
    """ConfigError when the daemon's cell is another one: moves are chosen by this file and checked by that.

    `seen`: of the taught view, before anything moved. A simulated daemon has no file to compare.
    """
    if seen.board != cell.board:
        raise ConfigError("The daemon runs with another board.", code="other-cell", remedy=_SAME_FILE)
    if seen.source == "real" and seen.config_sha256 != config_sha256:
        raise ConfigError(
            "The daemon runs with another configuration, or with this one as it was before.",
            code="other-cell",
            remedy=_SAME_FILE,
        )


def slow_plan(cell: StationConfig, move: PlannedPose) -> Plan:
    """One move of the bootstrap as a plan."""
    return Plan(
        cell.robot.model,
        cell.mount,
        (move,),
        joint_speed_rad_s=_JOINT_SPEED_RAD_S,
        joint_acceleration_rad_s2=_JOINT_ACCELERATION_RAD_S2,
        note="bootstrap",
    )


async def _standing(socket: Path, mount: Mount) -> Vector6:
    """Joints where the arm stands. ConfigError when the daemon's cell is of the other mount."""
    async with await Client.connect(socket) as client:
        status = await wait_until_idle(client)
    if status.mount != mount:
        raise ConfigError(
            f"The configuration says {mount}, the daemon's cell is {status.mount}.",
            code="other-cell",
            remedy=_SAME_FILE,
        )
    return joints_of(status)


def _show(what: str, guess: PoseGuess) -> None:
    x, y, z = (1000 * v for v in guess.translation_m)
    sigma = f"± {1000 * guess.sigma_m:.1f} mm, {np.rad2deg(guess.sigma_rad):.2f}° (1 sigma per axis)"
    err.print(f"{what:<7} {x:.1f}, {y:.1f}, {z:.1f} mm {sigma}")
