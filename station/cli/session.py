"""The commands of a session: `capture`, `resume`, `replan`, `next-pose` and `drift-check`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.text import Text

from station.cell.errors import ConfigError, RefusedError, StationError
from station.cell.plan import Plan
from station.cell.socket_folder import default_socket
from station.cell.status import MotionPreview, StationStatus
from station.cli.console import AsJson, Headless, Socket, err, out
from station.operate.attend import Confirm, Outcome, carry_out, wait_until_idle
from station.operate.drift_check import (
    PLAN_ANSWER_S,
    POSES,
    SEED,
    check_arguments,
    never_run,
    require_installed,
)
from station.operate.progress import SessionProgress
from station.plan.files import load_plan, sweep_plan
from station.protocol.client import Client

Approve = Annotated[str, typer.Option("--approve", help="Hash of the plan that a person approved.")]


def capture_command(
    plan: Annotated[Path | None, typer.Option(help="The pose plan.")] = None,
    sweep: Annotated[
        bool, typer.Option("--sweep", help="Swing slowly about where the arm stands, camera running.")
    ] = False,
    headless: Headless = False,
    approve: Approve = "",
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Capture all poses of a plan into a recording. Ctrl-C stops the arm.

    `station plan` makes the plan. Next: `calibrate solve RECORDING`. Nobody there:
    `--headless --approve HASH`, with the hash (12 digits and more) that `station plan --json` prints, as a
    user that the configuration names in approval.services.

    With --sweep no poses are taken: the arm swings slowly where it stands, with the board in view, and
    `calibrate sweep RECORDING` tells the time between camera and robot.

    Exit codes: 0 all poses, sealed; 1 failed or stopped; 2 usage; 3 sealed with fewer poses than planned.
    """
    if (plan is None) != sweep:
        raise ConfigError("say what to do, one of: --plan FILE (poses), --sweep (the clocks)")
    if plan is None:
        before = load_sweep
    else:
        before = partial(load_into, plan=load_plan(plan))
    outcome = asyncio.run(attended_session(socket, "run", headless, approve, as_json, before))
    if sweep and outcome.recording and not as_json:
        out.print(f"next: calibrate sweep {outcome.recording}")
    _finish(outcome, as_json)


def resume_command(
    headless: Headless = False,
    approve: Approve = "",
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Continue a paused or interrupted session. Ctrl-C stops the arm.

    Shows what would move and asks. After STOP or a fault first `station acknowledge`.

    Exit codes: as of `station capture`.
    """
    _finish(asyncio.run(attended_session(socket, "resume", headless, approve, as_json, None)), as_json)


def replan_command(headless: Headless = False, socket: Socket = None, as_json: AsJson = False) -> None:
    """Replan the remaining poses of a paused session from its images.

    Shows what would change and asks; then goes on with the session. Ctrl-C stops the arm.
    """
    _finish(asyncio.run(attended_session(socket, "improve", headless, "", as_json, None)), as_json)


def next_pose_command(headless: Headless = False, socket: Socket = None) -> None:
    """Add the most useful pose to a paused session and capture it.

    Shows the pose and its gain, and asks; its path is checked as any other. Then the session is paused as
    before, or finished when no other pose was left. Ctrl-C stops the arm.

    Exit codes: 0 it was taken, 1 it was not.
    """
    outcome = asyncio.run(attended_session(socket, "best", headless, "", False, None))
    added = max(outcome.status.session.poses, key=lambda pose: pose.index)
    out.print(f"pose {added.index + 1}: {added.state}{f', {added.reason}' if added.reason else ''}")
    _say_state(outcome.status, outcome.status.reason or outcome.recording)
    raise typer.Exit(0 if added.state == "done" else 1)


def drift_check_command(
    poses: Annotated[int, typer.Option(min=4, max=50, help="How many to take")] = POSES,
    headless: Headless = False,
    approve: Approve = "",
    socket: Socket = None,
) -> None:
    """Check on a few new poses whether the installed calibration holds.

    The board may lie elsewhere by now. Eight poses detect a shift of 0.5 mm or 0.1° on a usual cell, five on
    a quiet one; where they do not, it says how many more would. Ctrl-C stops the arm.

    Exit codes: 0 it holds, 4 it does not, 1 no recording or nothing installed, 2 usage.
    """
    asyncio.run(_require_installed(socket or default_socket()))  # or the arm would move for nothing
    outcome = asyncio.run(
        attended_session(socket, "check", headless, approve, False, lambda c: _make(c, poses))
    )
    if not outcome.recording:
        _finish(outcome, False)
    what = check_arguments(outcome.recording, outcome.status.session.folder)
    done = subprocess.run([sys.executable, "-m", "calibrate.cli", *what])
    raise typer.Exit(done.returncode)


async def _require_installed(socket: Path) -> None:
    async with await Client.connect(socket) as client:
        assert client.root is not None
        require_installed(client.root)


async def load_into(client: Client, plan: Plan) -> None:
    await client.request("load_plan", plan=msgspec.to_builtins(plan))


async def load_sweep(client: Client) -> None:
    """A sweep about where the arm stands now."""
    status = await wait_until_idle(client)
    if status.robot.joints_rad is None:
        raise RefusedError("the robot's joints are not known: `station doctor` says why")
    await load_into(client, sweep_plan(status.robot.model, status.mount, status.robot.joints_rad))


async def _make(client: Client, poses: int) -> None:
    if lost := never_run(await _status(client)):
        err.print(f"the check takes the place of the loaded plan of {lost} poses, which was never run")
    await client.request("make_plan", poses=poses, seed=SEED, lens_known=True, timeout_s=PLAN_ANSWER_S)


async def attended_session(
    socket: Path | None,
    purpose: str,
    headless: bool,
    approved: str,
    quiet: bool,
    before: Callable[..., Any] | None,
) -> Outcome:
    """One session as `purpose` says, approved by a person here or by the hash of what was approved."""
    path = socket or default_socket()
    interactive = not headless and sys.stdin.isatty()
    async with await Client.connect(path) as client:
        await wait_until_idle(client)
        await client.request("lease", action="take")
        if before is not None:
            await before(client)
        standing = await _status(client)
        progress = SessionProgress(err, quiet=headless or quiet)
        progress.skip(standing)
        confirm = _confirmation(approved, interactive, standing.simulated)
        with progress:
            # One pose more never ends a session that has others left.
            to_the_end = headless and purpose != "best"
            return await carry_out(
                client,
                purpose,
                confirm=confirm,
                watch=progress,
                finish_with_loss=to_the_end,
                headless=not interactive,
            )


async def _status(client: Client) -> StationStatus:
    async for status in client.statuses():
        return status
    raise StationError("the daemon ended")


def _confirmation(approved: str, interactive: bool, simulated: bool) -> Confirm:
    """Who says yes: the approved hash, the person, or, for a simulated cell only, nobody."""

    def confirm(summary: MotionPreview) -> bool:
        if approved:
            if not summary.plan_sha256.startswith(approved) or len(approved) < 12:
                raise RefusedError(f"--approve {approved} is not the hash of this plan: nothing moved")
            return True
        if interactive:
            return ask_person(summary)
        if simulated:
            return True
        raise RefusedError("Nobody is asked here. A person must review and approve the plan (docs: Safety).")

    return confirm


def ask_person(summary: MotionPreview) -> bool:
    many = "1 pose" if summary.poses == 1 else f"{summary.poses} poses"
    err.print(Text.assemble(("\nThe arm will move", "bold"), f": {summary.purpose}, {many}"))
    err.print(f"first {summary.first_move}; {summary.path_m:.2f} m, up to {summary.top_speed_m_s:.2f} m/s")
    err.print(f"about {summary.duration_s:.0f} s, plan {summary.plan_sha256[:12]}")
    for change in summary.changes:
        err.print(change)
    for warning in summary.warnings:
        err.print(warning, style="yellow")
    err.print("The emergency stop on the pendant is the safety device. Ctrl-C stops too.")
    try:
        with ctrl_c_at_once():
            return typer.confirm("Is everybody out of the arm's reach? Move?", default=False, err=True)
    except typer.Abort:
        err.print()  # after the terminal's ^C
        return False


@contextlib.contextmanager
def ctrl_c_at_once() -> Iterator[None]:
    """At a question: the event loop, which waits for the answer too, would hear of Ctrl-C only after it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _finish(outcome: Outcome, as_json: bool) -> None:
    if as_json:
        poses = {"planned": outcome.planned, "captured": outcome.captured}
        state = outcome.status.state.value
        print(json.dumps({"state": state, "poses": poses, "recording": outcome.recording}))
    elif outcome.recording:
        out.print(f"{outcome.captured} of {outcome.planned} poses, sealed: {outcome.recording}")
    else:
        _say_state(outcome.status, outcome.status.reason)
    raise typer.Exit(outcome.exit_code)


def _say_state(status: StationStatus, why: str) -> None:
    err.print(Text.assemble((status.state.value, "bold"), f": {why}"))
