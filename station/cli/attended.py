"""A session attended from a shell: who approves it, its progress, and what Ctrl-C does."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from types import TracebackType

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from station.cell.errors import RefusedError, StationError
from station.cell.socket_folder import default_socket
from station.cell.status import Event, MotionPreview, StationStatus
from station.cli.console import err
from station.operate.motion import (
    HASH_DIGITS,
    carry_out,
    motion_facts,
    not_approved,
    status_now,
    wait_until_idle,
    watched,
)
from station.protocol.client import Client
from station.protocol.verbs import Purpose, Stop

STOP_ANSWER_S = 3.0


class Attended:
    """A connection, and the person, or the approved hash, behind it."""

    def __init__(
        self, socket: Path, client: Client, simulated: bool, headless: bool, approved: str, quiet: bool
    ) -> None:
        self.client, self.progress = client, SessionProgress(err, quiet=headless or quiet)
        self.interactive = not headless and sys.stdin.isatty()
        self.moving = False
        """A motion was approved: from now on Ctrl-C sends STOP."""
        self._socket, self._simulated, self._approved = socket, simulated, approved
        self._headless = headless

    async def approves(self, preview: MotionPreview) -> bool:
        """By the approved hash, by the person, or, for a simulated cell only, by nobody."""
        yes = self._decides(preview)
        await asyncio.sleep(0)  # Ctrl-C at the question strikes here, before the approval is sent
        self.moving = yes
        return yes

    async def plans_here(self, refusal: StationError) -> bool:
        """Ask whether to plan again from where the arm stands; the plan's file stays as it is."""
        err.print(refusal.text, style="yellow")
        return confirmed("Plan again from here? Nothing moves.", default=True)

    def _decides(self, preview: MotionPreview) -> bool:
        if self._approved:
            if not preview.plan_sha256.startswith(self._approved) or len(self._approved) < HASH_DIGITS:
                raise RefusedError("other-plan")
            return True
        if self.interactive:
            return ask_person(preview)
        if self._simulated:
            return True
        raise no_terminal("A person must review and approve the plan (docs: Safety).")

    async def status(self) -> StationStatus:
        """The status now, by a new connection: no status waited there while a person was asked."""
        return await status_now(self._socket)

    def require_simulated(self) -> None:
        """RefusedError on a real cell, where nothing moves without a person."""
        if not self._simulated:
            raise RefusedError("no-person", advice="--json prompts nobody, and is for simulated cells only.")

    async def carry_out(self, purpose: Purpose) -> StationStatus:
        """One session, until it rests."""
        self.progress.skip(await self.status())
        with self.progress:
            return await carry_out(
                self.client,
                purpose,
                self.approves,
                self.progress,
                finish_with_loss=self._headless,
                headless=not self.interactive,
                plans_here=self.plans_here if self.interactive else None,
            )

    async def watch(self, started: object) -> StationStatus:
        """A session that was just started, until it rests. RefusedError when it was not `started`."""
        if not started:
            raise not_approved()
        with self.progress:
            return await watched(self.client, self.progress, finish_with_loss=self._headless)


@contextlib.asynccontextmanager
async def attended(
    socket: Path | None, headless: bool = False, approved: str = "", quiet: bool = False, camera: bool = True
) -> AsyncIterator[Attended]:
    """A connection to the cell that serves `socket`, its devices connected. Ctrl-C stops what was approved.

    `camera`: it is needed, too.
    """
    path = socket or default_socket()
    async with Client(path) as client:
        simulated = (await wait_until_idle(client, camera=camera)).simulated
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


class SessionProgress:
    """Context manager; call it with every status. Silent when `quiet`.

    The bar appears with the first status, so that a question before the go has the terminal to itself.
    """

    def __init__(self, console: Console, quiet: bool) -> None:
        self._quiet = quiet
        self._bar = Progress(
            TextColumn("{task.description:<34}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            disable=quiet,
        )
        self._task: TaskID | None = None
        self._last: Event | None = None

    def __enter__(self) -> SessionProgress:
        return self

    def say(self, text: str) -> None:
        """One line about what is going on outside a session."""
        if not self._quiet:
            self._bar.console.print(Text(text, "dim"))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def skip(self, status: StationStatus) -> None:
        """Skip the events of this status: they happened before."""
        if status.events:
            self._last = status.events[-1]

    def __call__(self, status: StationStatus) -> None:
        if self._quiet:
            return
        session = status.session
        if self._task is None:
            self._bar.start()
            self._task = self._bar.add_task("", total=len(session.poses))
        where = f"pose {session.current + 1} " if session.current is not None else ""
        self._bar.update(
            self._task,
            description=f"{where}{status.state.value}",
            total=len(session.poses),
            completed=session.captured,
        )
        for event in self._new(status):
            number = f"pose {event.pose_index + 1:>2}  " if event.pose_index is not None else ""
            style = {"warning": "yellow", "error": "red"}.get(event.level, "dim")
            self._bar.console.print(Text(f"{number}{event.text}", style))

    def _new(self, status: StationStatus) -> list[Event]:
        events = list(status.events)
        if self._last in events:
            events = events[events.index(self._last) + 1 :]
        if status.events:
            self._last = status.events[-1]
        return events
