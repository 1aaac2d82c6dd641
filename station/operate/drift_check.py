"""Drift check: capture a few poses in place of the loaded plan and test the installed calibration by them."""

from __future__ import annotations

from pathlib import Path

from calibrate.check.history import read_checks
from calibrate.files.install import installed_calibration
from station.cell.status import SessionStatus, StationState, StationStatus
from station.operate.ending import Ending, after_drift_check
from station.operate.motion import PREPARE_S, Approve, prepared_motion
from station.protocol.client import Client
from station.protocol.verbs import GetPlan, LoadPlan, MakePlan, Prepare, Purpose

POSES = 8
"""Default number of poses. Eight detect a shift of 0.5 mm in 96 % of cases at mid noise, five in 88 %
(docs/contributor/benchmarks.md)."""
SEED = 0


async def start_drift_check(link: Client, status: StationStatus, approve: Approve, poses: int = POSES) -> str:
    """Plan a few poses, ask, start. Returns the plan's SHA-256; empty: not approved, nothing moved.

    A loaded plan that was never run is named in the question, and loaded again where nothing was started.
    Raises CalibrationError before anything is planned when nothing is installed below the daemon's root.
    """
    installed_calibration(link.root, link.camera)
    before = (await link.call(GetPlan())).plan if _never_run(status) else None
    lost = 0 if before is None else len(before.poses)
    changes = () if before is None else (f"replaces the loaded plan of {lost} poses, which was never run",)
    made = await link.call(MakePlan(poses, SEED, lens_known=True), timeout_s=PREPARE_S)
    started = False
    try:
        started = await prepared_motion(link, Prepare(Purpose.DRIFT_CHECK), approve, changes=changes)
    finally:
        if before is not None and not started:
            await link.call(LoadPlan(before))
    return made.sha256 if started else ""


def _never_run(status: StationStatus) -> bool:
    """Tell whether a plan is loaded of which no pose was ever tried, so that it should be kept."""
    poses = status.session.poses
    return bool(poses) and not any(pose.attempt for pose in poses)


async def recorded(link: Client, plan_sha256: str) -> SessionStatus | None:
    """Wait until the recording of the plan's session is finished, also after pauses; return the session.

    None when another plan takes its place, or when the daemon ends.
    """
    seen = False
    async for status in link.statuses():
        session = status.session
        ours = session.plan_sha256 == plan_sha256
        if seen and not ours:
            return None
        seen = seen or ours
        if ours and session.recording and status.state is StationState.IDLE:
            return session
    return None


def judged(folder: str, camera: str) -> Ending | None:
    """Judge this session's drift check and say what to do after it; None: it was not judged."""
    path = Path(folder).resolve()
    history = read_checks(path.parents[1], camera)
    entry = next((entry for entry in reversed(history) if entry.recording == path.name), None)
    if entry is None:
        return None
    return after_drift_check(entry)


def check_arguments(recording: str, folder: str) -> tuple[str, ...]:
    """Arguments of `calibrate`. A session lies in ROOT/sessions/NAME: what is installed there is checked."""
    return ("drift-check", recording, "--root", str(Path(folder).resolve().parents[1]))
