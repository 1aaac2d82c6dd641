"""Results and installed calibrations as they lie on the disk."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from calibrate.check.history import FILE as CHECKS_FILE
from calibrate.check.history import CheckEntry, read_checks
from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, Override, Verdict, read_calibration
from calibrate.files.folders import calibrations_folder, current_version, validity_of
from calibrate.files.install import objections_beside
from calibrate.files.validity import Validity, ValidityState, parse_time
from calibrate.files.validity_log import FILE as VALIDITY_FILE
from calibrate.files.versions import InstalledVersion, LogEntry, installed_versions, read_log, same_solve
from recordings.files import MAIN_CAMERA
from station.cell.session_folder import CALIBRATION_FILE, SessionSummary, list_sessions
from station.cell.status import SessionStatus

Marks = frozenset[tuple[str, int]]


@dataclass(frozen=True)
class Installed:
    """What was ever installed for one camera."""

    now: Calibration | None = None
    """What programs read; None when there is nothing, or it is damaged."""
    validity: Validity | None = None
    """Whether `now` still holds."""
    earlier: tuple[Calibration, ...] = ()
    """Other solves that were installed before."""
    drift: tuple[CheckEntry, ...] = ()
    """Drift checks of `now`, oldest first."""
    checks: tuple[CheckEntry, ...] = ()
    """Drift checks of every version, oldest first."""
    log: tuple[LogEntry, ...] = ()
    """Every installation, oldest first."""

    def word(self, calibration: Calibration) -> str:
        """State of a calibration that is or was installed; else empty."""
        if same_solve(calibration, self.now):
            return self.held
        before = any(same_solve(calibration, earlier) for earlier in self.earlier)
        return "installed before" if before else ""

    @property
    def held(self) -> str:
        """INSTALLED, and its validity where that is not valid; WITHDRAWN: programs are refused it."""
        if self.withdrawn:
            return "WITHDRAWN"
        if self.validity is None or self.validity.state is ValidityState.VALID:
            return "INSTALLED"
        return f"INSTALLED, {self.validity.state.replace('-', ' ')}"

    @property
    def doubted(self) -> bool:
        """`now` is in doubt, or withdrawn."""
        doubts = ValidityState.IN_DOUBT, ValidityState.WITHDRAWN
        return self.validity is not None and self.validity.state in doubts

    @property
    def withdrawn(self) -> bool:
        """A person took `now` out of use."""
        return self.validity is not None and self.validity.state is ValidityState.WITHDRAWN


def read_installed(root: Path, camera: str = MAIN_CAMERA) -> Installed:
    """Read all of one camera, in a thread: many files take a moment."""
    folder = calibrations_folder(root, camera)
    now, validity, log, checks = None, None, list[LogEntry](), list[CheckEntry]()
    with suppress(CalibrationError, OSError):
        number, path = current_version(folder)  # one version, whatever is installed meanwhile
        now, validity = _read_at(path, path.stat().st_mtime_ns), validity_of(folder, number)
    with suppress(CalibrationError, OSError):
        log = read_log(root, camera)
    with suppress(CalibrationError, OSError):
        checks = read_checks(root, camera)
    versions = {entry.generation: readable(folder, entry.generation) for entry in log}
    ours = [number for number, version in versions.items() if version and same_solve(version, now)]
    earlier = [version for number, version in versions.items() if version and number not in ours]
    drift = [check for check in checks if check.generation in ours]
    return Installed(now, validity, tuple(earlier), tuple(drift), tuple(checks), tuple(log))


def readable(folder: Path, version: int | None = None) -> Calibration | None:
    """Read a calibration file, or a version installed below `folder`; None when it is damaged or gone."""
    path = folder if version is None else next((folder / "gen").glob(f"{version:04d}-*.yaml"), folder)
    try:
        return _read_at(path, path.stat().st_mtime_ns)
    except (CalibrationError, OSError):
        return None


@lru_cache(maxsize=256)
def _read_at(path: Path, changed_ns: int) -> Calibration:
    return read_calibration(path)


def local(iso: str) -> str:
    """Convert a file's UTC time to local time; what is no time stays as it is."""
    when = parse_time(iso)
    return iso if when is None else when.astimezone().strftime("%Y-%m-%d %H:%M")


def state_root(calibration: str | Path) -> Path:
    """Return ROOT of ROOT/sessions/NAME/FILE, or of an installed version."""
    above = Path(calibration).resolve().parents
    return above[4] if (above[3].name, above[2].name) == ("calibrations", "cameras") else above[2]


def solved_file(session: SessionStatus, root: Path, camera: str) -> str:
    """Return the calibration file made from a session; empty: none yet.

    Before a session and in a drift check, that of what is installed, or the installed file itself.
    """
    path = Path(session.folder) / CALIBRATION_FILE
    if session.check or not session.name:
        if (now := read_installed(root, camera).now) is None:
            return ""
        path = root / "sessions" / now.provenance.session / CALIBRATION_FILE
        if not same_solve(now, readable(path)):
            path = current_version(calibrations_folder(root, camera))[1]
    return str(path) if path.is_file() else ""


def marks(root: Path) -> Marks:
    """Note when each session and installation below this root changed; other programs change them too.

    A folder changes when a file comes or leaves, a link when its target does. Reads the disk: for a thread.
    """
    folders = [calibrations_folder(root), *(root / "calibrations" / "cameras").glob("*")]
    found = set[tuple[str, int]]()
    for path in (
        *(root / "sessions").glob("*"),
        *(f / n for f in folders for n in ("current", VALIDITY_FILE, CHECKS_FILE)),
    ):
        with suppress(OSError):
            found.add((str(path), path.lstat().st_mtime_ns))
    return frozenset(found)


@dataclass(frozen=True)
class Result:
    """A calibration file as the screen shows it, beside what is installed."""

    path: str
    calibration: Calibration | None = None
    """None: it cannot be read, and `problem`."""
    state: Installed = Installed()
    objections: tuple[str, ...] = ()
    """What installing would ask a reason for, besides failed gates; none where it is installed."""
    problem: str = ""

    @property
    def installed(self) -> bool:
        return self.calibration is not None and same_solve(self.calibration, self.state.now)

    @property
    def withdrawn(self) -> bool:
        """It was installed, and a person took it out of use."""
        return self.installed and self.state.withdrawn

    @property
    def taken(self) -> Override | None:
        """A person's decision by which it is installed although something speaks against it."""
        return self.state.now.override if self.installed and self.state.now else None

    @property
    def verdict(self) -> Verdict:
        """PASS WITH A REASON also where all gates pass, but installing needed a reason, or would."""
        if self.calibration is None:
            return "FAIL"
        verdict = self.calibration.verdict
        return "PASS WITH A REASON" if verdict == "PASS" and (self.taken or self.objections) else verdict


def read_result(path: str) -> Result:
    """Read the result, for a thread. What cannot be read is said in `problem`."""
    try:
        root, calibration = state_root(path), read_calibration(Path(path))
        state = read_installed(root, calibration.camera_name)
        found = objections_of(calibration, root, state)
    except CalibrationError as problem:
        return Result(path, problem=str(problem))
    return Result(path, calibration, state, found)


def objections_of(
    calibration: Calibration,
    root: Path,
    state: Installed,
    known: Sequence[InstalledVersion] | None = None,
) -> tuple[str, ...]:
    """List what installing would ask a reason for; none where it is installed. `known`: all versions."""
    if same_solve(calibration, state.now):
        return ()
    return tuple(objections_beside(calibration, root, known))


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
    verdict: Verdict = "FAIL"
    """Of its calibration, as Result says it."""


def read_sessions(root: Path, camera: str) -> tuple[Kept, ...]:
    """Read what became of each session, newest first; for a thread."""
    installed = read_installed(root, camera)
    versions = list[InstalledVersion]()
    with suppress(CalibrationError, OSError):
        versions = installed_versions(root, camera)
    judged = {check.recording: check for check in installed.checks}
    kept = []
    for session in list_sessions(root):
        made = readable(Path(session.calibration)) if session.calibration else None
        if made is None:
            kept.append(Kept(session, check=judged.get(session.name)))
            continue
        ours = versions if made.camera_name == camera else None
        found = tuple[str, ...]()
        with suppress(CalibrationError, OSError):
            found = objections_of(made, root, installed, ours)
        shown = Result(session.calibration, made, installed, found)
        kept.append(Kept(session, made, installed.word(made), judged.get(session.name), shown.verdict))
    return tuple(kept)
