"""The commands of a session: `capture`, `resume` and `drift-check`."""

from __future__ import annotations

import asyncio
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.text import Text

from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan
from station.cell.status import CHECK_VIEWS, StationState, StationStatus
from station.cli.attended import attended
from station.cli.console import AsJson, Headless, Socket, err, out, print_json
from station.operate.drift_check import check_arguments, judged, start_drift_check
from station.operate.ending import after_capture
from station.plan.files import load_plan
from station.protocol.verbs import LoadPlan, Purpose

Approve = Annotated[str, typer.Option("--approve", help="Hash of the approved plan, 12 digits or more")]


def capture_command(
    plan: Annotated[Path, typer.Option(help="Pose plan from `station plan`")],
    headless: Headless = False,
    approve: Approve = "",
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Capture the poses of a plan. Ctrl-C stops the arm.

    Shows what would move and asks. Next: `calibrate solve RECORDING`. With nobody there a real arm needs
    `--headless --approve HASH`: the hash that `station plan --json` prints, given as a user that the
    configuration names in approval.services.

    Exit codes: 0 all poses captured, 1 failed or stopped, 2 usage, 3 poses missing.
    """
    poses = load_plan(plan)
    _finish(asyncio.run(session(socket, Purpose.RUN, headless, approve, as_json, poses)), as_json)


def resume_command(
    headless: Headless = False,
    approve: Approve = "",
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Continue a paused or interrupted session. Ctrl-C stops the arm.

    Shows what would move and asks. After STOP or a fault first `station acknowledge`.

    Exit codes: those of `station capture`.
    """
    _finish(asyncio.run(session(socket, Purpose.RESUME, headless, approve, as_json)), as_json)


def drift_check_command(
    poses: Annotated[int, typer.Option(min=4, max=50, help="Poses to capture")] = CHECK_VIEWS,
    headless: Headless = False,
    approve: Approve = "",
    socket: Socket = None,
) -> None:
    """Check by a few new poses that the calibration holds.

    The board may lie elsewhere by now. Eight poses detect a shift of 0.5 mm or 0.1° on a usual cell, five on
    a quiet one; where they do not, it says how many more would. Ctrl-C stops the arm.

    Exit codes: 0 PASS, 4 FAIL, 1 no recording or nothing installed, 2 usage.
    """

    async def captured() -> tuple[StationStatus, str]:
        async with attended(socket, headless, approve, quiet=headless) as shell:
            standing = await shell.status()
            if standing.robot.by_hand:  # a person who moves it needs the picture
                identity = standing.robot.identity
                raise RefusedError("moved-by-hand", robot=identity.model if identity else "The arm")
            started = await start_drift_check(shell.client, standing, shell.approves, poses)
            return await shell.watch(started, standing), shell.client.camera

    outcome, camera = asyncio.run(captured())
    if not outcome.session.recording:
        _finish(outcome, False)
    what = check_arguments(outcome.session.recording, outcome.session.folder)
    done = subprocess.run([sys.executable, "-m", "calibrate.cli", *what])
    if (end := judged(outcome.session.folder, camera)) is not None:
        out.print(str(end))
    raise typer.Exit(done.returncode)


async def session(
    socket: Path | None,
    purpose: Purpose,
    headless: bool,
    approved: str,
    quiet: bool,
    plan: Plan | None = None,
) -> StationStatus:
    """One session, approved by a person here or by the hash of what was approved."""
    async with attended(socket, headless, approved, headless or quiet) as shell:
        if plan is not None:
            await shell.client.call(LoadPlan(plan))
        return await shell.carry_out(purpose)


class PosesJson(msgspec.Struct, frozen=True):
    planned: int
    captured: int


class SessionJson(msgspec.Struct, frozen=True):
    """`station capture --json`, `station resume --json`"""

    state: StationState
    poses: PosesJson
    recording: str


def _finish(outcome: StationStatus, as_json: bool) -> None:
    session = outcome.session
    if as_json:
        poses = PosesJson(len(session.poses), session.captured)
        print_json(SessionJson(outcome.state, poses, session.recording))
    elif session.recording:
        out.print(f"{session.captured} of {len(session.poses)} poses, finished: {session.recording}")
        out.print(str(after_capture(session)))
        if not session.check:
            out.print(f"Next: calibrate solve {shlex.quote(session.recording)}", soft_wrap=True)
    else:
        err.print(Text.assemble((outcome.state.value, "bold"), f": {outcome.reason}"))
    raise typer.Exit(1 if not session.recording else 3 if session.captured < len(session.poses) else 0)
