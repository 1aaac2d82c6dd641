"""A session attended from a shell: who approves it, what is shown meanwhile, and what Ctrl-C does."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import typer

from station.cell.errors import RefusedError, StationError
from station.cell.socket_folder import default_socket
from station.cell.status import MotionPreview, StationStatus
from station.cli.console import err
from station.cli.progress import SessionProgress
from station.operate.motion import (
    HASH_DIGITS,
    SessionOutcome,
    carry_out,
    motion_facts,
    not_approved,
    status_now,
    wait_until_idle,
    watched,
)
from station.protocol.client import Client
from station.protocol.verbs import Lease, Purpose, Stop

STOP_ANSWER_S = 3.0


class Attended:
    """A connection that has control, and the person, or the approved hash, behind it."""

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
                raise RefusedError(
                    f"--approve {self._approved} is not the hash of this plan: nothing moved.",
                    code="other-plan",
                    remedy=f"Give at least {HASH_DIGITS} digits of the hash that was reviewed.",
                )
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
            text = "Nothing moved: --json prompts nobody, and is for simulated cells only."
            raise RefusedError(text, code="no-person")

    async def carry_out(self, purpose: Purpose) -> SessionOutcome:
        """One session, until it rests."""
        self.progress.skip(await self.status())
        # One pose more never ends a session that has others left.
        to_the_end = self._headless and purpose is not Purpose.NEXT_POSE
        with self.progress:
            return await carry_out(
                self.client,
                purpose,
                self.approves,
                self.progress,
                finish_with_loss=to_the_end,
                headless=not self.interactive,
                plans_here=self.plans_here if self.interactive else None,
            )

    async def watch(self, started: object) -> SessionOutcome:
        """A session that was just started, until it rests. RefusedError when it was not `started`."""
        if not started:
            raise not_approved()
        with self.progress:
            return await watched(self.client, self.progress, finish_with_loss=self._headless)


@contextlib.asynccontextmanager
async def attended(
    socket: Path | None, headless: bool = False, approved: str = "", quiet: bool = False
) -> AsyncIterator[Attended]:
    """Control of the cell that serves `socket`, its devices connected. Ctrl-C stops what was approved."""
    path = socket or default_socket()
    async with await Client.connect(path) as client:
        simulated = (await wait_until_idle(client)).simulated
        await client.call(Lease("take"))
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
    return RefusedError("No terminal.", code="no-person", remedy=remedy)


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
