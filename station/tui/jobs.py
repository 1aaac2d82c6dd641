"""Work on recordings and results from the screen: solve, recover, check, install, undo.

Long work runs in a process of its own, its lines shown, and can be cancelled.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from calibrate.files.calibration import Calibration, Override
from recordings.errors import CodedError
from station.cell.errors import RefusedError
from station.cell.session_folder import solve_arguments
from station.operate.drift_check import check_arguments, recorded, start_drift_check
from station.operate.motion import Approve
from station.protocol.results import Installed, Result
from station.protocol.verbs import Install, Rollback, Withdraw
from station.tui.daemon_link import CHANGE_S, DaemonLink
from station.tui.dialogs import Confirm, JobScreen, Reason
from station.tui.words import local

OVERRIDABLE = ("gate-failed", "objection")
"""Codes of refusals that a person may override with a reason."""
OVERRIDES = "Your name and the reason go into the file. Enter installs, Escape does not."
NO_VERDICT = "Another session began: the drift check has no verdict. On 5, k judges the views it took."


async def solve_session(link: DaemonLink, recording: str, folder: str, without: Collection[int] = ()) -> None:
    """Solve, and show the result. without: pose numbers, from 0, of the views that a person excludes."""
    what = solve_arguments(recording, folder, without)
    code = await link.ask_person(JobScreen(f"Solving {Path(folder).name}", "calibrate.cli", *what))
    if code in (0, 4):
        await link.app.show_result(Path(folder).name)


async def recover_session(link: DaemonLink, folder: str) -> None:
    title = f"Recovering {Path(folder).name}"
    await link.ask_person(JobScreen(title, "recordings.cli", "recover", folder))


async def check_session(link: DaemonLink, recording: str, folder: str) -> None:
    """Check the installed calibration against this recording; the verdict stays until a person closes it."""
    title, arguments = f"Drift check on {Path(folder).name}", check_arguments(recording, folder)
    await link.ask_person(JobScreen(title, "calibrate.cli", *arguments, close_on=(), passed="PASS"))


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
    """Ask, then let the daemon install it, where that is refused with a person's reason."""
    if not await link.ask_person(install_question(result, calibration)):
        return
    put = Install(result.session)
    try:
        await link.client.call(put, timeout_s=CHANGE_S)
    except RefusedError as refusal:
        if refusal.code not in OVERRIDABLE:
            link.tell(refusal)
            return
        reason = await link.ask_person(Reason("Not installed", f"{refusal.text}\n\n{OVERRIDES}"))
        if not reason:
            link.app.notify("Nothing was installed.")
            return
        if await link.ask(Install(result.session, override=reason), timeout_s=CHANGE_S) is None:
            return
    except (CodedError, OSError) as problem:
        link.tell(problem)
        return
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


async def undo_install(link: DaemonLink, result: Result, _: Calibration) -> None:
    """Ask, then go back to the calibration before; without one, take this one out of use."""
    state = result.state
    if state.version is None:
        link.app.notify("Nothing is installed.")
        return
    if state.before is None:
        await _withdraw(link, state, state.version)
        return
    before = state.before
    named = _named(before.version, before.session, before.created, before.override)
    body = f"Now: {_now(state, state.version)}\nBefore: {named}\nPrograms then read the one before."
    if not await link.ask_person(Confirm("Go back to the calibration before?", body, yes="Go back")):
        return
    if await link.ask(Rollback(state.version), timeout_s=CHANGE_S) is not None:
        link.app.notify("The calibration before is installed again; a drift check proves it (d).")


async def _withdraw(link: DaemonLink, state: Installed, version: int) -> None:
    """Ask why, then withdraw what is installed."""
    if state.withdrawn:
        link.app.notify("It is out of use already, and there is none before it to go back to.")
        return
    body = (
        f"{_now(state, version)}\nThere is none before it to go back to. Programs of this cell are refused "
        "it from then on, until a calibration is installed.\n\nYour name and the reason are kept. "
        "Enter takes it out of use, Escape does not."
    )
    if not (reason := await link.ask_person(Reason("Take it out of use?", body))):
        return
    if await link.ask(Withdraw(reason, version), timeout_s=CHANGE_S) is not None:
        link.app.notify("Out of use: programs are refused it. i installs a calibration.")


def _now(state: Installed, version: int) -> str:
    """Name the installed version."""
    if state.now is None:
        return f"version {version}"
    return _named(version, state.now.provenance.session, state.now.created, state.now.override)


def _named(version: int, session: str, created: str, taken: Override | None) -> str:
    reason = "" if taken is None else f", overridden: “{taken.reason}”"
    return f"version {version}, session {session}, solved {local(created)}{reason}"
