"""The drift check from the screen: a few poses under a go of their own, then the verdict in words."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from calibrate.errors import CalibrationError
from station.cell.status import SessionStatus, StationState
from station.operate.drift_check import POSES, SEED, never_run, require_installed
from station.tui import offline

if TYPE_CHECKING:
    from station.tui.app import StationApp

LOOK_S = 0.2
PLANNING_CHECK = f"Planning the {POSES} poses of the check … Nothing moves."
INSTEAD = "takes the place of the loaded plan of {} poses, which was never run (a no keeps it)"
SHELLS_REMEDY = "Run: calibrate install FILE"
REMEDY = "3 shows the newest result, i installs it"
CHANGED = (
    "Another plan was loaded: the drift check has no verdict. Its pictures, if any, are on screen 4 (k)."
)


async def drift_check(app: StationApp) -> None:
    """Plans, asks, goes, and judges what was recorded, also after pauses and new goes in between."""
    if app.link is not None and app.link.root is not None:
        try:
            require_installed(app.link.root)
        except CalibrationError as problem:
            why = str(problem).replace(SHELLS_REMEDY, REMEDY)
            app.notify(f"No drift check: {why}", severity="warning", timeout=10)
            return
    before = "" if app.status is None else app.status.session.recording
    loaded = await _unused_plan(app)
    made = await app.ask_long(PLANNING_CHECK, "make_plan", poses=POSES, seed=SEED, lens_known=True)
    if made is None:
        return
    changes = () if loaded is None else (INSTEAD.format(len(loaded["poses"])),)
    if not await app.go_for("check", changes=changes):
        if loaded is not None:
            await app.ask_with_control("load_plan", plan=loaded)
        return
    await app.switch_mode("live")
    session = await _sealed(app, made["sha256"], before)
    if session is None:
        app.notify(CHANGED, timeout=10)
        return
    await offline.check(app, session.recording, session.folder)


async def _unused_plan(app: StationApp) -> dict[str, Any] | None:
    """The loaded plan when none of its poses was ever tried: somebody may still want it."""
    if app.status is None or not never_run(app.status):
        return None
    loaded = await app.ask("plan")
    return loaded["plan"] if loaded else None


async def _sealed(app: StationApp, plan_sha256: str, before: str) -> SessionStatus | None:
    """The session of this plan once its recording is closed; None when another plan takes its place.

    `before`: the recording that was shown until then; the same poses may have been driven before.
    """
    seen = False
    while True:
        if (status := app.status) is not None:
            session = status.session
            ours = session.plan_sha256 == plan_sha256
            if seen and not ours:
                return None
            seen = seen or ours
            if ours and session.recording not in ("", before) and status.state is StationState.IDLE:
                return session
        await asyncio.sleep(LOOK_S)
