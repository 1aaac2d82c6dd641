"""The installed calibration of this cell, and earlier ones: rolled back or replaced."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, Verdict, read_calibration
from calibrate.files.folders import calibrations_folder, current_validity
from calibrate.files.install import installed_calibration, objections_beside
from calibrate.files.touch import agrees
from calibrate.files.validity import FILE as VALIDITY_FILE
from calibrate.files.validity import Validity, ValidityState
from calibrate.files.versions import LogEntry, read_log, same_solve
from calibrate.quality.drift_history import CheckEntry, read_checks
from recordings.files import MAIN_CAMERA
from station.cell.session_folder import SessionSummary

Marks = frozenset[tuple[str, int]]


@dataclass(frozen=True)
class Ended:
    """The end of an installed calibration."""

    calibration: Calibration
    how: str
    """'rolled back' or 'replaced'"""
    by: str
    """'anna, 2026-11-22 04:50 (“the board had moved”)'"""


@dataclass(frozen=True)
class Installed:
    """`now`: what consumers of the cell read; None when there is nothing, or it is damaged."""

    now: Calibration | None = None
    ended: tuple[Ended, ...] = ()
    """Earlier ones, one a solve, the last to end last; without those that were installed again."""
    validity: Validity | None = None
    """Whether `now` still holds."""

    def word(self, session: str) -> str:
        """State of a session whose calibration is or was installed; else empty."""
        if self.now is not None and self.now.provenance.session == session:
            return self.held
        ends = [end.how for end in self.ended if end.calibration.provenance.session == session]
        return ends[-1] if ends else ""

    @property
    def held(self) -> str:
        """INSTALLED, and its validity where that is not valid."""
        if self.validity is None or self.validity.state is ValidityState.VALID:
            return "INSTALLED"
        return f"INSTALLED, {self.validity.state.replace('-', ' ')}"

    @property
    def withdrawn(self) -> bool:
        """A person took `now` out of use."""
        return self.validity is not None and self.validity.state is ValidityState.WITHDRAWN

    def end_of(self, calibration: Calibration) -> Ended | None:
        return next((end for end in self.ended if same_solve(end.calibration, calibration)), None)


def read_installed(root: Path, camera: str = MAIN_CAMERA) -> Installed:
    """Read all of one camera, in a thread: many files take a moment."""
    now, validity = None, None
    with suppress(CalibrationError):
        now = installed_calibration(root, camera)
        validity = current_validity(calibrations_folder(root, camera))
    ended: list[Ended] = []
    for before, entry in pairwise(_log(root, camera)):
        was = _generation(root, camera, before.generation)
        if was is None or entry.generation == before.generation or entry.action == "verify":
            continue  # a check by hand goes into a generation of its own, of the same solve
        how = "rolled back" if entry.action == "rollback" else "replaced"
        ended = [end for end in ended if not same_solve(end.calibration, was)]
        ended.append(Ended(was, how, _by(entry)))
    return Installed(now, tuple(end for end in ended if not same_solve(end.calibration, now)), validity)


def drift_history(root: Path, camera: str = MAIN_CAMERA) -> list[CheckEntry]:
    """Drift checks of what is installed now, oldest first; its touch tests do not begin another history."""
    held: set[int] = set()
    for entry in _log(root, camera):
        held = {entry.generation} | (held if entry.action == "verify" else set())
    return [check for check in read_checks(root, camera) if check.generation in held]


def _log(root: Path, camera: str) -> list[LogEntry]:
    """Read all installations; none where the log cannot be read."""
    try:
        return read_log(root, camera)
    except OSError:
        return []


def _generation(root: Path, camera: str, number: int) -> Calibration | None:
    """Read an installed version; None when it is damaged or gone."""
    return next(map(readable, (calibrations_folder(root, camera) / "gen").glob(f"{number:04d}-*.yaml")), None)


def readable(path: Path) -> Calibration | None:
    """Read a session's calibration, again only when the file changed; None when it is damaged."""
    try:
        return _read_at(path, path.stat().st_mtime_ns)
    except OSError:
        return None


@lru_cache(maxsize=256)
def _read_at(path: Path, changed_ns: int) -> Calibration | None:
    try:
        return read_calibration(path)
    except CalibrationError:
        return None


def _by(entry: LogEntry) -> str:
    return f"{entry.who}, {local(entry.wall)}" + (f" (“{entry.reason}”)" if entry.reason else "")


def local(iso: str) -> str:
    """Convert a file's UTC time to local time; what is no time stays as it is."""
    try:
        return datetime.fromisoformat(iso).astimezone().strftime("%Y-%m-%d %H:%M")
    except ValueError:
        return iso


def state_root(calibration: str | Path) -> Path:
    """Return ROOT of ROOT/sessions/NAME/FILE; what is installed lies below the same ROOT."""
    return Path(calibration).resolve().parents[2]


def marks(root: Path) -> Marks:
    """Note when each session and installation below this root changed; other programs change them too.

    Reads the disk: for a thread.
    """
    folders = [calibrations_folder(root), *(root / "calibrations" / "cameras").glob("*")]
    found = {_mark(folder / name) for folder in folders for name in ("current", VALIDITY_FILE)}
    try:
        with os.scandir(root / "sessions") as entries:
            found |= {_mark(Path(entry.path)) for entry in entries}
    except OSError:
        pass
    return frozenset(found)


def _mark(path: Path) -> tuple[str, int]:
    """Return a path and when it changed: a folder when a file came or left, a link when its target did."""
    try:
        return str(path), path.lstat().st_mtime_ns
    except OSError:
        return str(path), 0


@dataclass(frozen=True)
class Result:
    """A calibration file as the screens show it, beside what is installed."""

    path: str
    calibration: Calibration | None = None
    """None: it cannot be read, and `problem`."""
    state: Installed = Installed()
    objections: tuple[str, ...] = ()
    """What installing would ask a reason for, besides failed gates."""
    problem: str = ""
    drift: tuple[CheckEntry, ...] = ()
    """Drift checks of what is installed now, oldest first."""
    log: tuple[LogEntry, ...] = ()
    """Every installation, oldest first."""

    @property
    def installed(self) -> bool:
        return self.calibration is not None and same_solve(self.calibration, self.state.now)

    @property
    def verdict(self) -> Verdict:
        """PASS WITH A REASON: all gates pass, but installing needed a reason, or would."""
        if self.calibration is None or self.calibration.verdict == "FAIL":
            return "FAIL"
        off = not all(map(agrees, self.calibration.verification))
        taken = self.installed and self.state.now is not None and self.state.now.override is not None
        if taken or off or (self.objections and not self.installed):
            return "PASS WITH A REASON"
        return self.calibration.verdict


def read_result(path: str) -> Result:
    """Read the result, for a thread. What cannot be read is said in `problem`."""
    try:
        root = state_root(path)
        calibration = read_calibration(Path(path))
        camera = calibration.camera_name
        objections = tuple(objections_beside(calibration, root))
    except CalibrationError as problem:
        return Result(path, problem=str(problem))
    state, drift = read_installed(root, camera), tuple(drift_history(root, camera))
    return Result(path, calibration, state, objections, drift=drift, log=tuple(_log(root, camera)))


@dataclass(frozen=True)
class Kept:
    """A recorded session and what became of it."""

    session: SessionSummary
    calibration: Calibration | None = None
    """None: not solved, or damaged."""
    word: str = ""
    """Its calibration is or was installed; else empty."""
    check: CheckEntry | None = None
    """The verdict of the drift check that it was recorded for."""


def read_sessions(root: Path | None, camera: str, sessions: list[SessionSummary]) -> tuple[Kept, ...]:
    """Read what became of each session, newest first; for a thread."""
    installed = Installed() if root is None else read_installed(root, camera)
    judged = {} if root is None else {check.recording: check for check in read_checks(root, camera)}
    return tuple(
        Kept(
            session,
            readable(Path(session.calibration)) if session.calibration else None,
            installed.word(session.name),
            judged.get(session.name),
        )
        for session in sessions
    )
