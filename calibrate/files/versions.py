"""Folder of installed calibrations, and the one atomic switch between them.

    ROOT/calibrations/gen/0007-1a2b3c4d.yaml     every calibration ever installed, never changed
    ROOT/calibrations/current -> gen/0007-…      the installed calibration, which programs read
    ROOT/calibrations/validity.jsonl             who switched to what, when and why; validity (`validity`)

Camera `main` lies there, any other in ROOT/calibrations/cameras/NAME (`folders.calibrations_folder`).

After a power failure or kill at any moment, `current` is the old calibration or the new one, never neither.
"""

from __future__ import annotations

import fcntl
import getpass
import hashlib
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import msgspec

from calibrate.errors import CalibrationFileError, InstallError
from calibrate.files.calibration import (
    Calibration,
    decode_calibration,
    encode_calibration,
    read_calibration,
    write_calibration,
)
from calibrate.files.folders import (
    VERSION_NAME,
    calibrations_folder,
    current_name,
)
from calibrate.files.integrity import read_bounded
from calibrate.files.lines import share
from calibrate.files.touch import LIMIT_SIGMAS, Touch, agrees, touch_sigmas, touch_text
from calibrate.files.validity import Validity, ValidityReason, ValidityState, time_text
from calibrate.files.validity_log import log_lines, read_validity_log
from calibrate.files.validity_writer import append_to_log
from recordings.files import MAIN_CAMERA, open_regular, sync_folder, write_atomically
from recordings.plain_text import plain_text

_LOCK_TRIES, _LOCK_PAUSE_S = 50, 0.1
"""An installation takes a fraction of a second."""
Action = Literal["install", "rollback", "verify"]


@dataclass(frozen=True)
class InstalledVersion:
    number: int
    path: Path
    current: bool
    calibration: Calibration | None
    """Content; None when the file is damaged (`problem`)."""
    validity: Validity
    """Validity now; for a version that is not current, as when it was replaced."""
    problem: str = ""
    change: str = ""
    """Difference to the version before; of the one that was just switched to."""


class LogEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    wall: str
    action: Action
    generation: int
    who: str
    change: str = ""
    """Difference to the version before; for "verify", the result of the touch test."""
    reason: str = ""
    replaced: int | None = None
    """Version that was current before, 0 where there was none; None in older logs."""


def installed_versions(root: Path | None = None, camera: str = MAIN_CAMERA) -> list[InstalledVersion]:
    """List everything ever installed, oldest first; damaged files are listed with their problem.

    InstallError where the folder is not readable.
    """
    folder = calibrations_folder(root, camera)
    current, recorded, now = current_name(folder), read_validity_log(folder), datetime.now(UTC)
    found = []
    for path in sorted((folder / "gen").glob("*.yaml")):
        match = VERSION_NAME.fullmatch(path.name)
        if match is None:
            continue
        calibration, problem = None, ""
        try:
            calibration = read_calibration(path)
        except CalibrationFileError as damage:
            problem = str(damage)
        number, is_current = int(match[1]), path.name == current
        validity = recorded.of(number)
        validity = validity.at(now) if is_current else validity
        found.append(InstalledVersion(number, path, is_current, calibration, validity, problem))
    return sorted(found, key=lambda version: version.number)


def same_solve(one: Calibration, other: Calibration | None) -> bool:
    """Tell whether two calibrations differ at most in a person's override or touch tests."""
    if other is None:
        return False
    return msgspec.structs.replace(one, override=other.override, verification=other.verification) == other


def before_current(known: list[InstalledVersion], log: list[LogEntry]) -> InstalledVersion | None:
    """Find the version that a rollback goes to, None when there is none.

    It is the last in use before the current one that nobody went back from, and is undamaged, not withdrawn,
    and of another solve: a touch test makes a version too, and going back to the same numbers would undo
    nothing.
    """
    current = next((version for version in known if version.current), None)
    if current is None:
        return None
    used: list[int] = []
    for number in (entry.generation for entry in log):
        if number in used:
            del used[used.index(number) :]
        used.append(number)
    by_number = {version.number: version for version in known}
    for older in (by_number[number] for number in reversed(used) if number in by_number):
        withdrawn = older.validity.state is ValidityState.WITHDRAWN
        if older.calibration and not withdrawn and not same_solve(older.calibration, current.calibration):
            return older
    return None


def read_log(root: Path | None = None, camera: str = MAIN_CAMERA) -> list[LogEntry]:
    """List every switch, oldest first.

    A line is written before its switch. Where a crash prevented that, another version is replaced next.
    """
    folder = calibrations_folder(root, camera)
    current = _current_number(folder)
    entries = []
    for line in log_lines(folder):
        with suppress(msgspec.ValidationError):
            if line.plain is not None and "switch" in line.plain:
                entries.append(msgspec.convert(line.plain["switch"], LogEntry))
    current_after = [*(entry.replaced for entry in entries[1:]), current]
    pairs = zip(entries, current_after, strict=False)
    return [entry for entry, number in pairs if number in (entry.generation, None)]


def add_version(
    folder: Path,
    calibration: Calibration,
    action: Action,
    validity: Validity,
    change: str,
    reason: str = "",
    *,
    by: str = "",
) -> InstalledVersion:
    """Write a new version, make it the current one and log it. Call inside `locked` only.

    The file is durable and read back before `current` points to it. InstallError, CalibrationFileError.
    """
    content = encode_calibration(calibration)
    number = max(version_numbers(folder), default=0) + 1
    path = folder / "gen" / f"{number:04d}-{hashlib.sha256(content).hexdigest()[:8]}.yaml"
    try:
        write_atomically(path, content)
        share(path)
        decode_calibration(read_bounded(path), str(path))
        version = InstalledVersion(number, path, True, calibration, replace(validity, version=number))
        return make_current(folder, version, action, change, reason, by=by)
    except BaseException:
        if current_name(folder) != path.name:
            path.unlink(missing_ok=True)
        raise


def version_numbers(folder: Path) -> list[int]:
    """Return the numbers of all versions of which there is a file. Raises OSError."""
    names = [path.name for path in (folder / "gen").iterdir()]
    return [int(match[1]) for name in names if (match := VERSION_NAME.fullmatch(name))]


def make_current(
    folder: Path,
    version: InstalledVersion,
    action: Action,
    change: str,
    reason: str = "",
    *,
    by: str = "",
) -> InstalledVersion:
    """Switch to a version and log it. Call inside `locked` only. InstallError where it reads back wrong.

    `by`: who asked for it; empty: the user of this process.
    """
    replaced = _current_number(folder)
    entry = LogEntry(time_text(), action, version.number, by or who(), change, reason, replaced)
    line = asdict(version.validity) | {"switch": entry}
    append_to_log(folder, line, version_numbers(folder))  # before the switch, so that it is never missing
    _switch(folder, version.path.name, read_bounded(version.path))
    return replace(version, current=True, change=change)


def _current_number(folder: Path) -> int:
    match = VERSION_NAME.fullmatch(current_name(folder))
    return int(match[1]) if match else 0


def _switch(folder: Path, name: str, content: bytes) -> None:
    """Point `current` to gen/name by one rename, then compare what is read through it with `content`."""
    temporary = folder / "current.new"
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(Path("gen") / name)
    temporary.replace(folder / "current")
    sync_folder(folder)
    if read_bounded(folder / "current") != content:
        raise InstallError("read-back", path=folder / "current")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of installation, creating the folders where they are missing. Raises InstallError."""
    try:
        for part in (folder.parent, folder, folder / "gen", folder / "lock"):
            if not part.exists():
                part.touch() if part.name == "lock" else part.mkdir(parents=True, exist_ok=True)
                share(part)
        descriptor = open_regular(folder / "lock", os.O_RDWR)
    except OSError as problem:
        raise InstallError("state-folder", path=folder, why=problem.strerror) from None
    before = ""
    try:
        _take(descriptor, folder)
        before = current_name(folder)
        yield
    except OSError as problem:
        now, why = current_name(folder), problem.strerror or str(problem)
        raise InstallError(
            "install-io", folder=folder, why=why, now=now or "nothing", switched=now != before
        ) from None
    finally:
        os.close(descriptor)


def _take(descriptor: int, folder: Path) -> None:
    """Wait for the lock, and write into it who has it. InstallError where another holds it for too long."""
    for left in reversed(range(_LOCK_TRIES)):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except BlockingIOError:
            if not left:
                holder = plain_text(os.pread(descriptor, 200, 0).decode(errors="replace"))
                raise InstallError("install-busy", folder=folder, holder=holder or "a process") from None
            time.sleep(_LOCK_PAUSE_S)
    with suppress(OSError):  # a full disk, on which a withdrawal may still find room
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} of {who()}".encode(), 0)


def who() -> str:
    try:
        return plain_text(getpass.getuser())
    except (OSError, KeyError):
        return f"uid {os.getuid()}"


def note_in_file(path: Path, touches: Sequence[Touch]) -> Calibration:
    """Add touch tests to a calibration file, atomically; nothing else changes. CalibrationFileError."""
    calibration = _with_touches(read_calibration(path), touches)
    write_calibration(calibration, path)
    return calibration


def note_installed(
    root: Path | None, tested: Calibration, touches: Sequence[Touch], *, by: str = ""
) -> InstalledVersion | None:
    """Add touch tests to the installed calibration, as a new version, because versions never change.

    A failed corner puts it in doubt. None where what is installed is not of the same solve as `tested`.
    `by`: who tested it; empty: the user of this process.

    Raises InstallError where the folder cannot be written.
    """
    folder = calibrations_folder(root, tested.camera_name)
    if not current_name(folder):
        return None
    with locked(folder):
        current = next((g for g in installed_versions(root, tested.camera_name) if g.current), None)
        if current is None or current.calibration is None or not same_solve(tested, current.calibration):
            return None
        calibration = _with_touches(current.calibration, touches)
        found = "; ".join(touch_text(touch) for touch in touches)
        before = read_validity_log(folder).of(current.number)
        worst = max(map(touch_sigmas, touches), default=0.0)
        reason = ValidityReason(
            "touch-test",
            f"Touch test: {found}.",
            {"worst_sigmas": round(worst, 2), "limit_sigmas": round(LIMIT_SIGMAS, 2)},
        )
        now = datetime.now(UTC)
        passed = all(map(agrees, touches))
        validity = before.after_check(reason, passed, not passed, now, by or who())
        return add_version(folder, calibration, "verify", validity, found, by=by)


def _with_touches(calibration: Calibration, touches: Sequence[Touch]) -> Calibration:
    return msgspec.structs.replace(calibration, verification=[*calibration.verification, *touches])
