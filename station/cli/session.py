"""The commands of a session, `capture`, `resume` and `drift-check`: who approves, progress, and Ctrl-C."""

from __future__ import annotations

import asyncio
import contextlib
import shlex
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Annotated, NoReturn

import msgspec
import typer
from rich.console import Console
from rich.text import Text

from recordings.cli.console import progress_bar
from station.cell.errors import RefusedError, StationError
from station.cell.pose_plan import Plan
from station.cell.session_folder import solve_arguments
from station.cell.socket_folder import default_socket
from station.cell.status import CHECK_VIEWS, MotionPreview, StationState, StationStatus
from station.cli.console import AsJson, Headless, Socket, err, out, print_json
from station.devices.news import Delay
from station.operate.drift_check import check_arguments, start_drift_check
from station.operate.motion import (
    HASH_DIGITS,
    Watcher,
    motion_facts,
    prepared_motion,
    status_now,
    until_rest,
    wait_until_idle,
)
from station.plan.files import load_plan
from station.protocol.client import Client
from station.protocol.verbs import Acknowledge, Finish, LoadPlan, Prepare, Purpose, Stop

STOP_ANSWER_S = 3.0
APPROVED_AGAIN = 3
"""Times that a command that nobody attends approves the rest again, in a simulated cell."""


class Attended:
    """A connection, and the person, or the approved hash, behind it."""

    def __init__(
        self, socket: Path, client: Client, simulated: bool, headless: bool, approved: str, quiet: bool
    ) -> None:
        self.client, self.simulated = client, simulated
        self.interactive = not headless and sys.stdin.isatty()
        self.moving = False
        """A motion was approved: from now on Ctrl-C sends STOP."""
        self.approved_again = 0
        """How often it went on after robot states that came late."""
        self._socket, self._approved = socket, approved
        self._headless, self._quiet = headless, quiet

    async def approves(self, preview: MotionPreview) -> bool:
        """By the approved hash, by the person, or, for a simulated cell only, by nobody."""
        if self._approved:
            yes = preview.approval_sha256.startswith(self._approved) and len(self._approved) >= HASH_DIGITS
            if not yes:
                raise RefusedError("other-plan")
        elif self.interactive:
            yes = ask_person(preview)
        elif self.simulated:
            yes = True
        else:
            raise no_terminal("A person must review and approve the plan (docs: Safety).")
        await asyncio.sleep(0)  # Ctrl-C at the question strikes here, before the approval is sent
        self.moving = yes
        return yes

    async def plans_here(self, refusal: StationError) -> bool:
        """Ask whether to plan again from where the arm stands; the plan's file stays as it is."""
        err.print(refusal.text, style="yellow")
        return confirmed("Plan again from here? Nothing moves.", default=True)

    async def status(self) -> StationStatus:
        """The status now, by a new connection: no status waited there while a person was asked."""
        return await status_now(self._socket)

    async def carry_out(self, purpose: Purpose) -> StationStatus:
        """One session, until it rests."""
        before, plans_here = await self.status(), self.plans_here if self.interactive else None
        started = await prepared_motion(self.client, Prepare(purpose), self.approves, plans_here=plans_here)

        async def again() -> bool:
            return await prepared_motion(self.client, Prepare(purpose), self.approves)

        return await self.watch(started, before, again)

    async def watch(
        self, started: object, before: StationStatus, again: Callable[[], Awaitable[bool]]
    ) -> StationStatus:
        """A session that was just started, until it rests. RefusedError when it was not `started`.

        `again`: asks once more to start what did not begin.
        """
        if not started:
            raise RefusedError("not-approved")
        with session_progress(err, self._quiet, before) as show:
            status = await until_rest(self.client, show)
            while self._goes_on(status.cause):
                await self._go_on(status, again)
                status = await until_rest(self.client, show)
            if status.state is StationState.PAUSED and self._headless and status.session.captured:
                await self.client.call(Finish())
                status = await until_rest(self.client, show)
            return status

    def _goes_on(self, cause: str) -> bool:
        """Tell whether to approve again after what ended a motion, and count it.

        Only after late news, in a simulated cell that nobody attends.
        """
        unattended = self.simulated and self._headless
        late = cause in set(Delay) and self.approved_again < APPROVED_AGAIN
        self.approved_again += unattended and late
        return unattended and late

    async def _go_on(self, late: StationStatus, again: Callable[[], Awaitable[bool]]) -> None:
        """Acknowledge and approve the poses that are left, as a person at a real cell would."""
        if late.state is StationState.FAULT:
            await self.client.call(Acknowledge(late.cause))  # of no STOP by a person meanwhile
        begun = late.session.name and not late.session.recording
        while True:
            await wait_until_idle(self.client)
            try:
                if begun:
                    await prepared_motion(self.client, Prepare(Purpose.RESUME), self.approves)
                else:
                    await again()
                return
            except StationError as error:
                if not self._goes_on(error.code):
                    raise


@contextlib.asynccontextmanager
async def attended(
    socket: Path | None, headless: bool = False, approved: str = "", quiet: bool = False, camera: bool = True
) -> AsyncIterator[Attended]:
    """A connection to the cell that serves `socket`, its devices connected. Ctrl-C and Ctrl-Z stop the arm.

    `camera`: it is needed, too.
    """
    path = socket or default_socket()
    # Ctrl-Z would leave the arm moving, and this command unable to hear Ctrl-C: it means the same.
    asyncio.get_running_loop().add_signal_handler(signal.SIGTSTP, signal.raise_signal, signal.SIGINT)
    async with Client(path) as client:
        simulated = (await wait_until_idle(client, camera=camera)).source == "simulated"
        shell = Attended(path, client, simulated, headless, approved, quiet)
        try:
            yield shell
        except asyncio.CancelledError:
            if shell.moving:
                await stop_and_say(client)
            raise


async def stop_and_say(client: Client) -> None:
    """STOP for a person who pressed Ctrl-C, who reads on stderr what became of it."""
    try:
        await client.call(Stop(), timeout_s=STOP_ANSWER_S)
        told = (
            "STOP: the arm was stopped, nothing moves without a new approval. Look at the cell, then\n"
            "`station acknowledge`. `station resume` continues the session, `station finish` finishes it."
        )
    except StationError as problem:
        told = f"STOP was not answered: {problem} If the arm still moves use the emergency stop."
    print(f"\n{told}", file=sys.stderr)


def no_terminal(remedy: str = "A person must stand at the arm (docs: Safety).") -> RefusedError:
    return RefusedError("no-person", advice=remedy)


def ask_person(preview: MotionPreview) -> bool:
    """Show what would move, and ask."""
    err.print("\nThe arm will move", style="bold")
    for name, fact in motion_facts(preview):
        err.print(f"{name:<10} {fact}", style="yellow" if name == "WARNING" else None)
    err.print("The emergency stop on the pendant is the safety device. Ctrl-C stops too.")
    return confirmed("Is everybody out of the arm's reach? Start motion?")


def confirmed(question: str, default: bool = False) -> bool:
    """Ask a person; Ctrl-C is a no."""
    try:
        with ctrl_c_at_once():
            return typer.confirm(question, default=default, err=True)
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


@contextlib.contextmanager
def session_progress(console: Console, quiet: bool, before: StationStatus) -> Iterator[Watcher]:
    """Give what shows a session by each status; events of `before` are not told again."""
    if quiet:
        yield lambda status: None
        return
    told = before.events[-1:]
    with progress_bar("", console) as bar:

        def show(status: StationStatus) -> None:
            nonlocal told
            session = status.finished
            events = status.events
            where = f"pose {session.current + 1} " if session.current is not None else ""
            bar(session.captured, len(session.poses), f"{where}{status.state.value}")
            new = events[events.index(told[0]) + 1 :] if told and told[0] in events else events
            told = events[-1:] or told
            for event in new:
                number = f"pose {event.pose_index + 1:>2}  " if event.pose_index is not None else ""
                style = {"warning": "yellow", "error": "red"}.get(event.level, "dim")
                console.print(Text(f"{number}{event.text}", style))

        yield show


Approve = Annotated[str, typer.Option("--approve", help="Hash of approved plan and cell, 12 digits or more")]


def capture_command(
    plan: Annotated[Path, typer.Option(help="Pose plan from `station plan`")],
    headless: Headless = False,
    approve: Approve = "",
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Capture the poses of a plan. Ctrl-C stops the arm.

    Shows what would move and asks. Next: `calibrate solve RECORDING`. With nobody there a real arm needs
    `--headless --approve HASH`: approval_sha256 of `station plan --config FILE --json`, of plan and cell,
    given as a user that the configuration names in approval.services.

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
    poses: Annotated[int, typer.Option(min=4, max=50, help="Poses to plan and capture")] = CHECK_VIEWS,
    plan: Annotated[Path | None, typer.Option(help="Pose plan to capture in place of a new one")] = None,
    headless: Headless = False,
    approve: Approve = "",
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Check by a few new poses that the calibration holds.

    The board may lie elsewhere by now. Eight poses detect a shift of 0.5 mm or 0.1° on a usual cell, five on
    a quiet one; where they do not, it says how many more would. Ctrl-C stops the arm. With nobody there it
    needs `--plan FILE --headless --approve HASH`, as `station capture` does. --json prints what
    `calibrate drift-check --json` does.

    Exit codes: 0 PASS, 4 FAIL, 1 no recording or nothing installed, 2 usage.
    """

    async def captured() -> StationStatus:
        async with attended(socket, headless, approve, quiet=headless or as_json) as shell:
            standing = await shell.status()
            if standing.robot.by_hand:  # a person who moves it needs the picture
                identity = standing.robot.identity
                raise RefusedError("moved-by-hand", robot=identity.model if identity else "The arm")
            kept = None if plan is None else load_plan(plan)

            async def start() -> bool:
                return await start_drift_check(shell.client, standing, shell.approves, poses, kept)

            return await shell.watch(await start(), standing, start)

    outcome = asyncio.run(captured())
    check = outcome.checked
    if not check.recording:
        raise RefusedError("check-not-finished", state=outcome.state.value, reason=outcome.reason)
    what = (*check_arguments(check.recording, check.folder), *(["--json"] if as_json else []))
    done = subprocess.run([sys.executable, "-m", "calibrate.cli", *what])
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
    session = outcome.finished
    if as_json:
        poses = PosesJson(len(session.poses), session.captured)
        print_json(SessionJson(outcome.state, poses, session.recording))
    elif session.recording:
        out.print(f"{session.captured} of {len(session.poses)} poses, finished: {session.recording}")
        for pose in session.poses:
            if pose.state == "failed":
                out.print(f"Not captured: pose {pose.index + 1}. {pose.reason}")
        of_session = check_arguments if session.check else solve_arguments
        next_step = of_session(session.recording, session.folder)
        out.print(f"Next: calibrate {shlex.join(next_step)}")
    else:
        _not_finished(outcome)
    raise typer.Exit(1 if not session.recording else 3 if session.captured < len(session.poses) else 0)


def _not_finished(outcome: StationStatus) -> NoReturn:
    err.print(Text.assemble((outcome.state.value, "bold"), f": {outcome.reason}"))
    raise typer.Exit(1)
