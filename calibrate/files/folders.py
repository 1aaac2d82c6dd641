"""Folders of installed calibrations: their paths, the current version, its validity.

ROOT/calibrations/                  camera `main`: its versions, `current`, logs and validity
ROOT/calibrations/cameras/NAME/     the same for every other camera of the cell
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

from calibrate.errors import InstallError
from calibrate.files.validity import Validity
from calibrate.files.validity_log import read_validity_log
from recordings.files import MAIN_CAMERA, is_session_name, state_root

VERSION_NAME = re.compile(r"(\d{4,})-([0-9a-f]{8})\.yaml")
"""File of a version in `gen`: its number, and the first digits of the SHA-256 of its content."""


def calibrations_folder(root: Path | str | None, camera: str = MAIN_CAMERA) -> Path:
    """Return the folder of a camera's installed calibrations. InstallError for an invalid camera name."""
    if not is_session_name(camera):
        raise InstallError("camera-name", camera=camera)
    folder = state_root(root) / "calibrations"
    return folder if camera == MAIN_CAMERA else folder / "cameras" / camera


def cameras(root: Path | str | None = None) -> list[str]:
    """List the cameras for which something was ever installed below `root`, `main` first."""
    folder = calibrations_folder(root)
    current_name(folder)  # raises where nothing may be read
    others = sorted(path.parent.name for path in (folder / "cameras").glob("*/gen"))
    return [*([MAIN_CAMERA] if (folder / "gen").is_dir() else []), *filter(is_session_name, others)]


def current_name(folder: Path) -> str:
    """Return the file name of the current version; empty where nothing is installed.

    InstallError where the folder is not readable.
    """
    try:
        return (folder / "current").readlink().name
    except PermissionError as problem:
        raise InstallError("state-folder", path=folder, why=problem.strerror) from None
    except OSError:
        return ""


def current_version(folder: Path) -> tuple[int, Path]:
    """Return number and file of the current version. InstallError as `current_name`, or without one."""
    name = current_name(folder)
    match = VERSION_NAME.fullmatch(name)
    if match is None:
        raise InstallError("nothing-installed", folder=folder)
    return int(match[1]), folder / "gen" / name


def validity_of(folder: Path, number: int) -> Validity:
    """Read the validity now of version `number`, which need not be the current one."""
    try:
        found = read_validity_log(folder).of(number)
    except OSError as problem:
        raise InstallError(
            "state-folder", path=problem.filename or str(folder), why=problem.strerror
        ) from None
    return found.at(datetime.now(UTC))
