"""One session from the shell: prepare, ask, go, watch until it rests. For `capture`, `resume` and `demo`."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from station.cell.errors import RefusedError, StationError
from station.cell.status import MotionPreview, StationState, StationStatus
from station.protocol.client import Client, DaemonGoneError

Watcher = Callable[[StationStatus], None]
Confirm = Callable[[MotionPreview], bool]
CONNECT_WAIT_S = 30.0
STOP_ANSWER_S = 3.0
PREPARE_S = 180.0
"""Poses may be planned anew for it."""
_RESTING = (StationState.PAUSED, StationState.STOPPED, StationState.FAULT, StationState.DISCONNECTED)


@dataclass(frozen=True)
class Outcome:
    """How a session came to rest."""

    status: StationStatus

    @property
    def recording(self) -> str:
        """Path of the sealed recording; empty while there is none."""
        return self.status.session.recording

    @property
    def planned(self) -> int:
        return len(self.status.session.poses)

    @property
    def captured(self) -> int:
        return self.status.session.captured

    @property
    def exit_code(self) -> int:
        """0 all poses sealed, 3 sealed with fewer, 1 not sealed."""
        if not self.recording:
            return 1
        return 0 if self.captured == self.planned else 3


async def wait_until_idle(client: Client) -> StationStatus:
    """The devices need a moment after the daemon's start. RefusedError names what does not come."""
    status, told = StationStatus(), False
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(CONNECT_WAIT_S):
            async for status in client.statuses():
                told = status.playback or status.robot.joints_rad is not None
                if status.state is not StationState.DISCONNECTED and status.camera.connected and told:
                    return status
    missing = "the camera" if status.robot.connected and told else "the robot"
    raise RefusedError(f"{missing} did not come within {CONNECT_WAIT_S:.0f} s: `station doctor` says why")


async def carry_out(
    client: Client,
    purpose: str,
    *,
    confirm: Confirm,
    watch: Watcher,
    finish_with_loss: bool = False,
    headless: bool = False,
) -> Outcome:
    """Prepares, lets `confirm` decide, goes, and watches. `finish_with_loss`: seal although poses failed.

    `headless`: nobody will be asked on the way; poses that do not come to rest are tried once more.

    RefusedError when the daemon or the person says no. Being cancelled (Ctrl-C) sends STOP and says so.
    """
    answer = await client.request("prepare", purpose=purpose, timeout_s=PREPARE_S)
    summary = msgspec.convert(answer, MotionPreview)
    if not confirm(summary):
        raise RefusedError("nothing moved: the go was not given")
    await asyncio.sleep(0)  # Ctrl-C at the question strikes here, before the go is sent
    try:
        await client.request("go", token=summary.token, plan_sha256=summary.plan_sha256, headless=headless)
        client.outdate()  # it would show the session before, sealed and at rest
        status = await watch_until_rest(client, watch)
        if status.state is StationState.PAUSED and finish_with_loss and status.session.captured:
            await client.request("finish")
            client.outdate()
            status = await watch_until_rest(client, watch)
    except asyncio.CancelledError:
        await stop_and_say(client)
        raise
    return Outcome(status)


async def stop_and_say(client: Client) -> None:
    """STOP for a person who pressed Ctrl-C, who reads on stderr what became of it."""
    try:
        await client.request("stop", timeout_s=STOP_ANSWER_S)
        told = (
            "STOP: the arm was stopped, nothing moves without a new go. Look at the cell.\n"
            "`station acknowledge`, then `station resume` goes on with it, `station finish` closes it."
        )
    except StationError as problem:
        told = f"STOP was not answered: {problem} If the arm still moves use the emergency stop."
    print(f"\n{told}", file=sys.stderr)


async def watch_until_rest(client: Client, watch: Watcher) -> StationStatus:
    """The status in which the session rests."""
    async for status in client.statuses():
        watch(status)
        if status.state in _RESTING:
            return status
        if status.state is StationState.IDLE and (status.session.recording or status.reason):
            return status
    raise DaemonGoneError("the daemon ended during the session; what was saved before is safe")
