"""Reading and changing results, sessions and what is installed, in a process of its own.

A calibration file takes a tenth of a second, and a daemon may keep hundreds of them. What was read is kept
until its file changes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import msgspec

from calibrate.check.history import CheckEntry, read_checks
from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, read_calibration
from calibrate.files.folders import calibrations_folder, current_version, validity_of
from calibrate.files.formatting import figures
from calibrate.files.install import installed_calibration, objections_beside
from calibrate.files.touch import Touch
from calibrate.files.versions import (
    InstalledVersion,
    LogEntry,
    before_current,
    installed_versions,
    note_in_file,
    note_installed,
    read_log,
    same_solve,
)
from station.analysis.pool import live_with_parent
from station.cell.session_folder import CALIBRATION_FILE, REPORT_FILE, SessionSummary, list_sessions
from station.protocol.results import Installed, InstalledBefore, Kept, Result
from station.protocol.verbs import TouchesNoted

NICENESS = 10
"""Behind the daemon's worker, which detects boards."""


def start_reader() -> None:
    """Set up the process: whoever waits for a list waits longer, and no capture does."""
    live_with_parent()
    with suppress(OSError):  # a service may not be permitted to
        os.nice(NICENESS)


@dataclass(frozen=True)
class History:
    """What was ever installed for one camera, and every check of it."""

    installed: Installed
    earlier: tuple[Calibration, ...] = ()
    """Other solves that were installed before."""
    checks: tuple[CheckEntry, ...] = ()
    """Drift checks of every version, oldest first."""
    versions: tuple[InstalledVersion, ...] = ()

    def beside(self, path: Path, calibration: Calibration, root: Path) -> Result:
        """Put a calibration beside what is installed. Raises CalibrationError."""
        objections: Sequence[str] = ()
        if not same_solve(calibration, self.installed.now):
            objections = objections_beside(calibration, root, self.versions)
        before = any(same_solve(calibration, earlier) for earlier in self.earlier)
        folder = path.parent
        report = folder / REPORT_FILE
        return Result(
            str(path),
            calibration,
            self.installed,
            tuple(objections),
            session=folder.name if folder.parent == root / "sessions" else "",
            installed_before=before,
            report=str(report) if report.is_file() else "",
        )


def read_history(root: Path, camera: str) -> History:
    """Read all of one camera. What is damaged hides nothing else."""
    folder = calibrations_folder(root, camera)
    now, number, validity = None, None, None
    log, checks, versions = list[LogEntry](), list[CheckEntry](), list[InstalledVersion]()
    with suppress(CalibrationError, OSError):
        number, path = current_version(folder)  # one version, whatever is installed meanwhile
        now = _read_at(path, path.stat().st_mtime_ns)
        validity = validity_of(folder, number)
    with suppress(CalibrationError, OSError):
        versions = installed_versions(root, camera)
    with suppress(CalibrationError, OSError):
        log = read_log(root, camera)
    with suppress(CalibrationError, OSError):
        checks = read_checks(root, camera)
    read = {version.number: version.calibration for version in versions}
    solves = {entry.generation: read.get(entry.generation) for entry in log}
    ours = [version for version, solve in solves.items() if solve and same_solve(solve, now)]
    earlier = [solve for version, solve in solves.items() if solve and version not in ours]
    installed = Installed(
        now,
        number,
        validity,
        _before(versions, log),
        tuple(check for check in checks if check.generation in ours),
        log[-1] if log else None,
    )
    return History(installed, tuple(earlier), tuple(checks), tuple(versions))


def _before(versions: list[InstalledVersion], log: list[LogEntry]) -> InstalledBefore | None:
    """Name the version that an undo goes back to; None: there is none."""
    older = before_current(versions, log)
    if older is None or older.calibration is None:
        return None
    found = older.calibration
    return InstalledBefore(older.number, found.provenance.session, found.created, found.override)


def readable(path: Path) -> Calibration | None:
    """Read a calibration file; None when it is damaged or gone."""
    try:
        return _read_at(path, path.stat().st_mtime_ns)
    except (CalibrationError, OSError):
        return None


@lru_cache(maxsize=256)
def _read_at(path: Path, changed_ns: int) -> Calibration:
    return read_calibration(path)


def read_result(path: Path, root: Path) -> Result:
    """Read the calibration at `path`, beside what is installed for its camera.

    What cannot be read is said in `problem`.
    """
    try:
        calibration = _read_at(path, path.stat().st_mtime_ns)
        found = read_history(root, calibration.camera_name).beside(path, calibration, root)
    except CalibrationError as problem:
        return Result(str(path), problem=str(problem))
    except OSError as problem:
        return Result(str(path), problem=f"{path}: {problem.strerror}")
    return found


def read_sessions(root: Path, camera: str) -> tuple[Kept, ...]:
    """Read what became of each session, newest first."""
    histories = {camera: read_history(root, camera)}
    judged = {check.recording: check for check in histories[camera].checks}
    found = []
    for session in list_sessions(root):
        check = judged.get(session.name)
        made = readable(Path(session.calibration)) if session.calibration else None
        if made is None:
            found.append(Kept(session, check=check))
            continue
        if made.camera_name not in histories:
            histories[made.camera_name] = read_history(root, made.camera_name)
        found.append(_solved(session, made, root, histories[made.camera_name], check))
    return tuple(found)


def _solved(
    session: SessionSummary, made: Calibration, root: Path, history: History, check: CheckEntry | None
) -> Kept:
    """Say what became of a session that was solved."""
    path = Path(session.calibration)
    try:
        result = history.beside(path, made, root)
    except CalibrationError:
        result = Result(str(path), made, history.installed)
    figure = figures(made)["error"]
    return Kept(session, result.verdict, result.became, (figure.value, figure.about), check)


def result_of(root: Path, camera: str, session: str, check: bool) -> dict[str, object] | None:
    """Read the calibration made from a session, as plain data; None: there is none yet.

    `session`: empty where none is loaded. Without one, and after a drift check, it is that of what is
    installed, or the installed version itself where it is no session's any more.
    """
    path = root / "sessions" / session / CALIBRATION_FILE
    if check or not session:
        history = read_history(root, camera).installed
        if history.now is None:
            return None
        path = root / "sessions" / history.now.provenance.session / CALIBRATION_FILE
        if not same_solve(history.now, readable(path)):
            path = current_version(calibrations_folder(root, camera))[1]
    if not path.is_file():
        return None
    return _plain(_shown(read_result(path, root)))


def sessions_of(root: Path, camera: str) -> list[dict[str, object]]:
    """Read what became of each session, newest first, as plain data."""
    return [_plain(kept) for kept in read_sessions(root, camera)]


def _shown(result: Result) -> Result:
    """Leave out what no screen shows, and what is most of the file."""
    if result.calibration is None:
        return result
    state = result.state
    if state.now is not None:
        state = msgspec.structs.replace(state, now=_without_posterior(state.now))
    return msgspec.structs.replace(result, calibration=_without_posterior(result.calibration), state=state)


def _without_posterior(calibration: Calibration) -> Calibration:
    return msgspec.structs.replace(calibration, posterior=None)


def _plain(struct: msgspec.Struct) -> dict[str, object]:
    plain: dict[str, object] = msgspec.to_builtins(struct)
    return plain


def require_readable(root: Path, camera: str) -> None:
    """Raise CalibrationError where nothing is installed, or its file is damaged."""
    installed_calibration(root, camera)


def install_session(root: Path, camera: str, session: str, put: Callable[[Path, Path], object]) -> None:
    """Install the calibration of a session by `put`; `session` as in `verbs.Install`."""
    put(_file(root, camera, session), root)


def carry_out(root: Path, change: Callable[[Path], object]) -> None:
    """Carry out a change of what is installed. What it returns is large, and not asked for."""
    change(root)


def note_touches(root: Path, camera: str, session: str, touches: list[Touch], by: str) -> TouchesNoted:
    """Write touch tests into the file of a session and into the installed version of the same solve.

    An installed version never changes: a new one has them.
    """
    file = _file(root, camera, session)
    noted = note_in_file(file, touches) if session else read_calibration(file)
    made = note_installed(root, noted, touches, by=by)
    return TouchesNoted(str(file) if session else "", None if made is None else made.number)


def _file(root: Path, camera: str, session: str) -> Path:
    """Return the calibration file of a session; without one the installed version."""
    if session:
        return root / "sessions" / session / CALIBRATION_FILE
    return current_version(calibrations_folder(root, camera))[1]
