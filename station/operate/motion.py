"""Motion that a person approves, as a client asks for it: check, show, start, watch until the arm rests.

What the daemon offers and what it refuses: `session.motion`.
"""

from __future__ import annotations

import contextlib
import math
from asyncio import timeout
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec

from station.cell.errors import RefusedError, StationError
from station.cell.pose_plan import Criterion
from station.cell.status import MotionPreview, StationState, StationStatus
from station.protocol.client import Client, DaemonGoneError
from station.protocol.verbs import PLANNED_ELSEWHERE, GetPlan, Go, MakePlan, Prepare

Watcher = Callable[[StationStatus], None]
Approve = Callable[[MotionPreview], Awaitable[bool]]
"""Function that shows a person a motion; True: they approve exactly this one."""
PlansHere = Callable[[StationError], Awaitable[bool]]
"""Function that shows why a plan is refused; True: make it again from where the arm stands."""
REPLACEABLE: Criterion = "A"
"""Criterion of plans that may be replaced by a new one; taught or listed poses never are."""
HASH_DIGITS = 12
"""Digits of the hash of plan and cell that are shown, and the fewest accepted for an approval."""
CONNECT_WAIT_S = 30.0
PREPARE_S = 200.0
"""Time-out of a preflight check, which may plan poses: up to minutes on a busy computer."""
_RESTING = (StationState.PAUSED, StationState.STOPPED, StationState.FAULT, StationState.DISCONNECTED)


async def status_now(socket: Path) -> StationStatus:
    """Return the present status by a new connection, on which none can be queued."""
    async with Client(socket) as client:
        async for status in client.statuses():
            return status
    raise DaemonGoneError("daemon-ended", during="before it told its status")


async def wait_until_idle(link: Client, *, camera: bool = True) -> StationStatus:
    """Wait until robot and camera are connected; return the status. RefusedError names what is missing."""
    told = False
    with contextlib.suppress(TimeoutError):
        async with timeout(CONNECT_WAIT_S):
            async for status in link.statuses():
                told = status.source == "playback" or status.robot.connected
                there = status.camera.connected or not camera
                if status.state is not StationState.DISCONNECTED and there and told:
                    return status
    raise RefusedError("no-camera" if told else "no-robot", limit_s=CONNECT_WAIT_S)


async def prepared_motion(
    link: Client,
    wanted: Prepare,
    approve: Approve,
    *,
    warnings: tuple[str, ...] = (),
    plans_here: PlansHere | None = None,
) -> bool:
    """Check the whole path, ask a person to approve the motion, and start it. False: not approved.

    `warnings`: shown before the daemon's own. `plans_here`: asks whether to plan again if the plan was made
    from another posture.
    """
    try:
        preview = await link.call(wanted, timeout_s=PREPARE_S)
    except StationError as refusal:
        if refusal.code != PLANNED_ELSEWHERE or plans_here is None:
            raise
        plan = (await link.call(GetPlan())).plan
        if plan is None or plan.criterion != REPLACEABLE or not await plans_here(refusal):
            raise
        await link.call(MakePlan(max(4, len(plan.poses)), plan.seed or 0), timeout_s=PREPARE_S)
        preview = await link.call(wanted, timeout_s=PREPARE_S)
    preview = msgspec.structs.replace(preview, warnings=(*warnings, *preview.warnings))
    if not await approve(preview):
        return False
    await link.call(Go(preview.token, preview.approval_sha256))
    return True


def motion_facts(preview: MotionPreview) -> list[tuple[str, str]]:
    """List names and values of a motion's figures, for the person who approves it."""
    turn_deg = math.degrees(preview.largest_step_rad)
    return [
        ("What", f"{preview.purpose}, {preview.poses} pose{'s' * (preview.poses != 1)}"),
        ("First", preview.first_move),
        ("Distance", f"{preview.path_m:.2f} m of flange path, largest joint turn {turn_deg:.0f}°"),
        ("Speed", f"up to {preview.top_speed_m_s:.2f} m/s at any point of arm, tool and camera"),
        ("Duration", f"about {preview.duration_s // 60:.0f}:{preview.duration_s % 60:02.0f} min"),
        ("Hash", f"{preview.approval_sha256[:HASH_DIGITS]} stands for exactly this plan and cell"),
        *(("WARNING", warning) for warning in preview.warnings),
    ]


async def until_rest(link: Client, watch: Watcher) -> StationStatus:
    """Watch a session until it ends or pauses."""
    async for status in link.statuses():
        watch(status)
        if status.state in _RESTING:
            return status
        if status.state is StationState.IDLE and (status.finished.recording or status.reason):
            return status
    raise DaemonGoneError("daemon-ended", during="during the session")
