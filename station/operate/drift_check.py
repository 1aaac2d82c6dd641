"""Drift check: capture a few poses in place of the loaded plan and test the installed calibration by them."""

from __future__ import annotations

from pathlib import Path

from station.cell.pose_plan import Plan
from station.cell.status import CHECK_VIEWS, SessionStatus, StationState, StationStatus
from station.operate.motion import PREPARE_S, Approve, prepared_motion
from station.protocol.client import Client
from station.protocol.verbs import Freedrive, GetInstalled, LoadPlan, MakePlan, Prepare, Purpose

SEED = 0
INSTALLED_S = 60.0
"""Longest wait until the installed calibration was read, on a busy computer."""


async def start_drift_check(
    link: Client,
    status: StationStatus,
    approve: Approve,
    poses: int = CHECK_VIEWS,
    plan: Plan | None = None,
) -> bool:
    """Plan a few poses, ask, start; an arm that a person moves is guided. False: not approved, nothing moved.

    `plan`: of the poses to capture, so that its hash is known before; None: `poses` new ones.

    What was loaded stands again where nothing was started. The question names a plan never run.
    Raises RefusedError before anything is planned when nothing is installed, or it cannot be read.
    """
    await link.call(GetInstalled(), timeout_s=INSTALLED_S)
    if status.robot.by_hand:
        await link.call(Freedrive(True, check=True))
        return True
    lost = _never_run(status)
    warnings = (f"the loaded plan of {lost} poses, never run, is replaced",) if lost else ()
    if plan is None:
        await link.call(MakePlan(poses, SEED, lens_known=True), timeout_s=PREPARE_S)
    else:
        await link.call(LoadPlan(plan))
    started = False
    try:
        started = await prepared_motion(link, Prepare(Purpose.DRIFT_CHECK), approve, warnings=warnings)
    finally:
        if not started:
            await link.call(LoadPlan())
    return started


def _never_run(status: StationStatus) -> int:
    """Count the poses of a loaded plan of which none was ever tried."""
    poses = status.session.poses
    return 0 if any(pose.attempt for pose in poses) else len(poses)


async def recorded(link: Client, before: str) -> SessionStatus | None:
    """Wait until the drift check's recording is finished, also after pauses; return the session.

    `before`: name of the check before it. None when another session begins, or when the daemon ends.
    """
    seen = False
    async for status in link.statuses():
        session = status.session
        checked = status.checked
        if checked.name not in ("", before):
            if status.state is StationState.IDLE:
                return checked
            continue
        ours = session.check and bool(session.name)
        if seen and not ours:
            return None
        seen = seen or ours
    return None


def check_arguments(recording: str, folder: str) -> tuple[str, ...]:
    """Arguments of `calibrate`. A session lies in ROOT/sessions/NAME: what is installed there is checked."""
    return ("drift-check", recording, "--root", str(Path(folder).resolve().parents[1]))
