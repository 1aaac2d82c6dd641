"""Work on recordings and results from the screen: solve, recover, check, install, undo.

Long work runs in a process of its own, its lines shown, and can be cancelled.
"""

from __future__ import annotations

import asyncio
from functools import partial
from pathlib import Path

from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration
from calibrate.files.install import Cell, install, rollback, withdraw
from calibrate.files.validity import ValidityState
from calibrate.files.versions import InstalledVersion, before_current, installed_versions, read_log
from station.cell.session_folder import CALIBRATION_FILE, REPORT_FILE
from station.operate.drift_check import check_arguments, recorded, start_drift_check
from station.operate.motion import Approve
from station.tui.desk import Desk
from station.tui.dialogs import Confirm, JobScreen, Reason
from station.tui.installed import Result, local, state_root

OVERRIDABLE = ("gate-failed", "objection")
"""Codes of refusals that a person may override with a reason."""
OVERRIDES = "Your name and the reason go into the file. Enter installs, Escape does not."
NO_VERDICT = "Another session began: the drift check has no verdict. Its views, if any, are on 5 (k)."


async def solve_session(desk: Desk, recording: str, folder: str) -> None:
    """Solve, and show the result."""
    output, report = (str(Path(folder) / name) for name in (CALIBRATION_FILE, REPORT_FILE))
    what = ("solve", recording, "-o", output, "--report", report)
    code = await desk.question(JobScreen(f"Solving {Path(folder).name}", "calibrate.cli", *what))
    if code in (0, 4):
        await desk.app.show_result(output)


async def recover_session(desk: Desk, folder: str) -> None:
    title = f"Recovering {Path(folder).name}"
    await desk.question(JobScreen(title, "recordings.cli", "recover", folder))


async def check_session(desk: Desk, recording: str, folder: str) -> None:
    """Check the installed calibration against this recording; the verdict stays until a person closes it."""
    title, arguments = f"Drift check on {Path(folder).name}", check_arguments(recording, folder)
    await desk.question(JobScreen(title, "calibrate.cli", *arguments, close_on=()))


async def check_drift(desk: Desk, approves: Approve) -> None:
    """Plan and ask, or guide by hand; capture (pauses included), then check for drift."""
    if (status := desk.known.live) is None:
        return
    if not await desk.start(start_drift_check(desk.client, status, approves)):
        return
    await desk.app.switch_mode("capture")
    session = await recorded(desk.client, status.session.name)
    if session is None:
        desk.app.notify(NO_VERDICT, timeout=10)
        return
    await check_session(desk, session.recording, session.folder)


async def install_result(desk: Desk, result: Result, calibration: Calibration) -> None:
    """Ask, then install. A simulated result installs on a simulated cell only."""
    session = calibration.provenance.session
    body = f"Session {session} becomes what every program of this cell reads. b undoes it."
    if not await desk.question(Confirm("Install this calibration?", body, yes="Install")):
        return
    cell: Cell = "simulated" if desk.known.live is not None and desk.known.live.simulated else "real"
    config = desk.client.config
    oldest = None if config is None else config.validity.max_age_days
    put = partial(install, Path(result.path), state_root(result.path), cell=cell, max_age_days=oldest)
    try:
        try:
            with desk.busy("Installing …"):
                await asyncio.to_thread(put)
        except CalibrationError as refusal:
            if refusal.code not in OVERRIDABLE:
                raise
            if not (reason := await desk.question(Reason("Not installed", f"{refusal.text}\n\n{OVERRIDES}"))):
                desk.app.notify("Nothing was installed.")
                return
            await asyncio.to_thread(put, override=reason)
    except CalibrationError as refusal:
        desk.app.notify(str(refusal), title="Not installed", severity="error", timeout=20, markup=False)
        return
    desk.app.result_path = result.path  # read again at once
    desk.app.notify("Installed. b undoes it.")


async def undo_install(desk: Desk, result: Result, calibration: Calibration) -> None:
    """Ask, then install the calibration before again; without one, take this one out of use."""
    root, camera = state_root(result.path), calibration.camera_name
    known = installed_versions(root, camera)
    current = next((g for g in known if g.current), None)
    older = before_current(known, read_log(root, camera))
    if current is None:
        desk.app.notify("Nothing is installed.")
        return
    if older is None:
        await _withdraw(desk, root, camera, current)
        return
    body = f"Now: {_named(current)}\nBefore: {_named(older)}\nPrograms then read the one before."
    if await desk.question(Confirm("Go back to the calibration before?", body, yes="Go back")):
        made = await desk.attempt(asyncio.to_thread(rollback, root, camera=camera))
        if made is not None:
            said = "The calibration before is installed again; a drift check proves it (d)."
            desk.app.notify(said)


async def _withdraw(desk: Desk, root: Path, camera: str, current: InstalledVersion) -> None:
    """Ask why, then withdraw what is installed."""
    if current.validity is not None and current.validity.state is ValidityState.WITHDRAWN:
        desk.app.notify("It is out of use already, and there is none before it to go back to.")
        return
    body = (
        f"{_named(current)}\nThere is none before it to go back to. Programs of this cell are refused it "
        "from then on, until a calibration is installed.\n\nYour name and the reason are kept. "
        "Enter takes it out of use, Escape does not."
    )
    if not (reason := await desk.question(Reason("Take it out of use?", body))):
        return
    if await desk.attempt(asyncio.to_thread(withdraw, root, reason, camera=camera)) is not None:
        desk.app.notify("Out of use: programs are refused it. i installs a calibration.")


def _named(generation: InstalledVersion) -> str:
    calibration = generation.calibration
    if calibration is None:
        return f"version {generation.number}"
    taken = calibration.override
    reason = "" if taken is None else f", overridden: “{taken.reason}”"
    session = calibration.provenance.session
    return f"version {generation.number}, session {session}, solved {local(calibration.created)}{reason}"
