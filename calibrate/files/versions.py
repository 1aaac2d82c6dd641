"""Folder of installed calibrations, and the one atomic switch between them.

    ROOT/calibrations/gen/0007-1a2b3c4d.yaml     every calibration ever installed, never changed
    ROOT/calibrations/current -> gen/0007-…      what consumers read
    ROOT/calibrations/log.jsonl                  who switched to what, when and why

Whoever loses power or is killed at any moment finds the old calibration or the new one.
"""

from __future__ import annotations

import fcntl
import getpass
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, NoReturn

import msgspec

from calibrate.errors import CalibrationError
from calibrate.files.calibration import (
    Calibration,
    CalibrationFileError,
    decode_calibration,
    encode_calibration,
    read_calibration,
)
from calibrate.files.lines import append_line, read_lines
from recordings.files import state_root, sync_folder, write_atomically

Action = Literal["install", "rollback", "verify"]
_NAME = re.compile(r"(\d{4,})-[0-9a-f]{8}\.yaml")


class InstallError(CalibrationError):
    """Refused or failed: what was installed before still is, or the message says what is now."""

    code = "install"


@dataclass(frozen=True)
class InstalledVersion:
    number: int
    path: Path
    current: bool
    calibration: Calibration | None
    """Content; None when the file is damaged (`problem`)."""
    problem: str = ""


class LogEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    wall: str
    action: Action
    generation: int
    who: str
    change: str = ""
    """Against what was installed before; for "verify" what was found."""
    reason: str = ""


def installed_versions(root: Path | None = None) -> list[InstalledVersion]:
    """List everything ever installed, oldest first; damaged files are listed with their problem.

    InstallError where the folder may not be looked into.
    """
    folder = readable_folder(root)
    current = _current_name(folder)
    found = []
    for path in sorted((folder / "gen").glob("*.yaml")):
        match = _NAME.fullmatch(path.name)
        if match is None:
            continue
        calibration, problem = None, ""
        try:
            calibration = read_calibration(path)
        except CalibrationFileError as damage:
            problem = str(damage)
        found.append(InstalledVersion(int(match[1]), path, path.name == current, calibration, problem))
    return sorted(found, key=lambda version: version.number)


def same_solve(one: Calibration, other: Calibration | None) -> bool:
    """They differ at most in what people added: a reason, or a check by hand."""
    if other is None:
        return False
    return msgspec.structs.replace(one, override=other.override, verification=other.verification) == other


def before_current(known: list[InstalledVersion]) -> InstalledVersion | None:
    """The newest whole one before the current one that is of another solve; None when there is none.

    A check by hand makes a version too: going back to the same numbers would undo nothing.
    """
    current = next((version for version in known if version.current), None)
    for older in reversed(known):
        if current is None or older.number >= current.number or older.calibration is None:
            continue
        if not same_solve(older.calibration, current.calibration):
            return older
    return None


def read_log(root: Path | None = None) -> list[LogEntry]:
    """Oldest first."""
    return read_lines(readable_folder(root) / "log.jsonl", LogEntry)


def add_version(
    root: Path | None, calibration: Calibration, action: Action, change: str, reason: str = ""
) -> InstalledVersion:
    """A new version with this content becomes the current one and is logged. Inside `locked` only.

    It is on the disk, whole, and read back before anything points to it. InstallError, CalibrationFileError.
    """
    folder = calibrations_folder(root)
    content = encode_calibration(calibration)
    number = _next_number(folder)
    path = folder / "gen" / f"{number:04d}-{_content_name(content)}.yaml"
    write_atomically(path, content)
    decode_calibration(path.read_bytes(), str(path))
    make_current(root, InstalledVersion(number, path, True, calibration), action, change, reason)
    return InstalledVersion(number, path, True, calibration)


def make_current(
    root: Path | None, version: InstalledVersion, action: Action, change: str, reason: str = ""
) -> None:
    """Switches to it, and writes that down. In `locked` only. InstallError where it does not read back."""
    folder = calibrations_folder(root)
    _switch(folder, version.path.name, version.path.read_bytes())
    entry = LogEntry(_now_text(), action, version.number, who(), change, reason)
    append_line(folder / "log.jsonl", entry)


def _content_name(content: bytes) -> str:
    """First 8 hex digits of the content's own hash, as written in the file."""
    found = re.search(rb"^sha256: '?([0-9a-f]{8})", content, re.MULTILINE)
    if found is None:
        raise CalibrationFileError("A calibration file without its hash cannot be installed.")
    return found[1].decode()


def calibrations_folder(root: Path | None) -> Path:
    return state_root(root) / "calibrations"


def readable_folder(root: Path | None) -> Path:
    """Folder of the calibrations; InstallError where it may not be looked into."""
    folder = calibrations_folder(root)
    try:
        (folder / "gen").exists()
    except PermissionError as problem:
        raise InstallError(
            f"{folder}: {problem.strerror}.",
            code="state-folder",
            remedy="Name another state folder with --root.",
        ) from None
    return folder


def _current_name(folder: Path) -> str:
    try:
        return (folder / "current").readlink().name
    except OSError:
        return ""


def _next_number(folder: Path) -> int:
    numbers = [int(m[1]) for p in (folder / "gen").iterdir() if (m := _NAME.fullmatch(p.name))]
    return max(numbers, default=0) + 1


def _switch(folder: Path, name: str, content: bytes) -> None:
    """`current` → gen/name by one rename, then read back through it."""
    temporary = folder / "current.new"
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(Path("gen") / name)
    temporary.replace(folder / "current")
    sync_folder(folder)
    if (folder / "current").read_bytes() != content:
        raise InstallError(
            f"{folder / 'current'} does not read back what was installed.",
            code="read-back",
            remedy="Check the disk.",
        )


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """One installer at a time; the folders exist inside."""
    try:
        (folder / "gen").mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o640)
    except OSError as problem:
        raise InstallError(
            f"{folder} cannot be used: {problem.strerror}.",
            code="state-folder",
            remedy="Name another with --root.",
        ) from None
    before = ""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        before = _current_name(folder)
        yield
    except OSError as problem:
        now = _current_name(folder)
        switched = (
            f"{now} is installed now, and the log may not say so" if now != before else "Nothing was switched"
        )
        raise InstallError(
            f"{folder}: {problem.strerror or problem}. {switched}.", code="install-io", switched=now != before
        ) from None
    finally:
        os.close(descriptor)


def no_such_version(folder: Path, number: int, known: list[InstalledVersion]) -> NoReturn:
    """Raises InstallError, which names those that there are."""
    have = ", ".join(str(g.number) for g in known) or "none"
    raise InstallError(
        f"{folder}: there is no version {number}; there are: {have}.",
        code="no-such-version",
        generation=number,
    )


def _now_text() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def who() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return f"uid {os.getuid()}"
