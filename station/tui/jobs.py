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
from station.cell.session_folder import CALIBRATION_FILE, solve_arguments
from station.operate.drift_check import check_arguments, recorded, start_drift_check
from station.operate.motion import Approve
from station.tui.daemon_link import DaemonLink
from station.tui.dialogs import Confirm, JobScreen, Reason
from station.tui.installed import Result, local, state_root

OVERRIDABLE = ("gate-failed", "objection")
"""Codes of refusals that a person may override with a reason."""
OVERRIDES = "Your name and the reason go into the file. Enter installs, Escape does not."
NO_VERDICT = "Another session began: the drift check has no verdict. On 5, k judges the views it took."


async def solve_session(link: DaemonLink, recording: str, folder: str) -> None:
    """Solve, and show the result."""
    what = solve_arguments(recording, folder)
    code = await link.ask_person(JobScreen(f"Solving {Path(folder).name}", "calibrate.cli", *what))
    if code in (0, 4):
        await link.app.show_result(str(Path(folder) / CALIBRATION_FILE))


async def recover_session(link: DaemonLink, folder: str) -> None:
    title = f"Recovering {Path(folder).name}"
    await link.ask_person(JobScreen(title, "recordings.cli", "recover", folder))


async def check_session(link: DaemonLink, recording: str, folder: str) -> None:
    """Check the installed calibration against this recording; the verdict stays until a person closes it."""
    title, arguments = f"Drift check on {Path(folder).name}", check_arguments(recording, folder)
    await link.ask_person(JobScreen(title, "calibrate.cli", *arguments, close_on=()))


async def check_drift(link: DaemonLink, approves: Approve) -> None:
    """Plan and ask, or guide by hand; capture (pauses included), then check for drift."""
    if (status := link.known.live) is None:
        return
    if not await link.start(start_drift_check(link.client, status, approves)):
        return
    await link.app.switch_mode("capture")
    session = await recorded(link.client, status.checked.name)
    if session is None:
        link.app.notify(NO_VERDICT, timeout=10)
        return
    await check_session(link, session.recording, session.folder)


async def install_result(link: DaemonLink, result: Result, calibration: Calibration) -> None:
    """Ask, then install. A simulated result installs on a simulated cell only."""
    if not await link.ask_person(install_question(result, calibration)):
        return
    live = link.known.live
    cell: Cell = "simulated" if live is not None and live.source == "simulated" else "real"
    config = link.client.config
    oldest = None if config is None else config.validity.max_age_days
    put = partial(install, Path(result.path), state_root(result.path), cell=cell, max_age_days=oldest)
    if await link.attempt(_installed(link, put)) is not None:
        link.app.result_path = link.app.result_path  # the same, but its file is read again
        link.app.notify("Installed. b undoes it.")


def install_question(result: Result, calibration: Calibration) -> Confirm:
    """Ask whether to install, and say first what speaks against it."""
    session = calibration.provenance.session
    against = [f"✗ {gate.text}" for gate in calibration.quality.failed]
    against += [f"▲ {objection}" for objection in result.objections]
    if not against:
        body = f"Session {session} becomes what every program of this cell reads. b undoes it."
        return Confirm("Install this calibration?", body, yes="Install")
    title = "Install it with a reason?"
    if calibration.quality.failed:
        title = "It FAILED. Install it all the same?"
    reads = (
        f"Session {session} would become what every program of this cell reads. Your reason is asked next."
    )
    return Confirm(title, "\n".join([*against, "", reads]), yes="Give a reason")


async def _installed(link: DaemonLink, put: partial[InstalledVersion]) -> InstalledVersion | None:
    """Install, where it is refused with a person's reason; None: none was given. Raises CalibrationError."""
    try:
        with link.busy("Installing …"):
            return await asyncio.to_thread(put)
    except CalibrationError as refusal:
        if refusal.code not in OVERRIDABLE:
            raise
        asked = f"{refusal.text}\n\n{OVERRIDES}"
    if reason := await link.ask_person(Reason("Not installed", asked)):
        return await asyncio.to_thread(put, override=reason)
    link.app.notify("Nothing was installed.")
    return None


async def undo_install(link: DaemonLink, result: Result, calibration: Calibration) -> None:
    """Ask, then install the calibration before again; without one, take this one out of use."""
    root, camera = state_root(result.path), calibration.camera_name
    known = installed_versions(root, camera)
    current = next((g for g in known if g.current), None)
    older = before_current(known, read_log(root, camera))
    if current is None:
        link.app.notify("Nothing is installed.")
        return
    if older is None:
        await _withdraw(link, root, camera, current)
        return
    body = f"Now: {_named(current)}\nBefore: {_named(older)}\nPrograms then read the one before."
    if await link.ask_person(Confirm("Go back to the calibration before?", body, yes="Go back")):
        made = await link.attempt(asyncio.to_thread(rollback, root, camera=camera))
        if made is not None:
            said = "The calibration before is installed again; a drift check proves it (d)."
            link.app.notify(said)


async def _withdraw(link: DaemonLink, root: Path, camera: str, current: InstalledVersion) -> None:
    """Ask why, then withdraw what is installed."""
    if current.validity.state is ValidityState.WITHDRAWN:
        link.app.notify("It is out of use already, and there is none before it to go back to.")
        return
    body = (
        f"{_named(current)}\nThere is none before it to go back to. Programs of this cell are refused it "
        "from then on, until a calibration is installed.\n\nYour name and the reason are kept. "
        "Enter takes it out of use, Escape does not."
    )
    if not (reason := await link.ask_person(Reason("Take it out of use?", body))):
        return
    if await link.attempt(asyncio.to_thread(withdraw, root, reason, camera=camera)) is not None:
        link.app.notify("Out of use: programs are refused it. i installs a calibration.")


def _named(generation: InstalledVersion) -> str:
    calibration = generation.calibration
    if calibration is None:
        return f"version {generation.number}"
    taken = calibration.override
    reason = "" if taken is None else f", overridden: “{taken.reason}”"
    session = calibration.provenance.session
    return f"version {generation.number}, session {session}, solved {local(calibration.created)}{reason}"
