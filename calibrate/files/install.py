"""Install a calibration, load it in other programs, and roll back. Its folder: `versions`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from calibrate.errors import GateFailedError
from calibrate.files.calibration import Calibration, Gate, Override, read_calibration
from calibrate.files.verification import agrees, touch_text
from calibrate.files.versions import (
    InstalledVersion,
    InstallError,
    add_version,
    before_current,
    calibrations_folder,
    installed_versions,
    locked,
    make_current,
    no_such_version,
    readable_folder,
    who,
)
from calibrate.geometry import difference
from recordings.schema.messages import Source

Cell = Literal["real", "imported", "simulated"]
_CELL_OF: dict[Source, Cell] = {
    "real": "real",
    "imported": "imported",
    "simulated": "simulated",
    "playback": "simulated",
}
_ARTICLE: dict[Cell, str] = {"real": "a", "imported": "an", "simulated": "a"}

WORSE_TIMES = 1.5
"""More than the estimates of two good sessions differ by chance."""
REASON_LETTERS = 5
"""Different ones; fewer are a pressed key, not words, in any script."""


class InstallGateError(GateFailedError, InstallError):
    """A gate failed and nobody gave a reason to override it."""

    code = "gate-failed"


def load_installed(root: Path | None = None, allow_simulated: bool = False) -> Calibration:
    """Load the installed calibration, verified: the call for programs that use the camera.

    `calibration.transform` is `flange_from_camera` (eye-in-hand) or `base_from_camera` (eye-to-hand), with
    both frame names in it; `calibration.intrinsics.model` is the lens. Raises InstallError when nothing is
    installed or when it is simulated and that was not asked for, CalibrationFileError when it is damaged.
    """
    current = readable_folder(root) / "current"
    if not current.exists():
        raise InstallError(
            f"{current}: nothing is installed.",
            code="nothing-installed",
            remedy="Run: calibrate install FILE",
        )
    calibration = read_calibration(current)
    if _CELL_OF[calibration.source] == "simulated" and not allow_simulated:
        raise InstallError(
            f"{current}: the installed calibration is {calibration.source}, not of a real cell.",
            code="not-real",
            source=calibration.source,
        )
    return calibration


def install(
    path: Path,
    root: Path | None = None,
    *,
    cell: Cell = "real",
    override: str = "",
    robot_serial: str = "",
    camera_serial: str = "",
) -> InstalledVersion:
    """Make the calibration file `path` the current one.

    `cell`: what kind of cell this root belongs to; a real one takes nothing simulated, played back or
    imported, and no override changes that. `override`: a person's reason to install although a gate failed
    or robot or camera differ; it goes into the file. `robot_serial`, `camera_serial`: of the cell's own
    configuration, when known. Raises InstallError (also as exit code 4 for a gate) or CalibrationFileError.
    """
    calibration = read_calibration(path)
    with locked(calibrations_folder(root)):
        before = _installed_before(root)
        _refuse_foreign_source(calibration, before, cell, path)
        objections = _objections(calibration, before, robot_serial, camera_serial)
        objections += [f"Touch test, {touch_text(t)}." for t in calibration.verification if not agrees(t)]
        failed = [f"{gate.name}: {gate.text}" for gate in _failed_gates(calibration, before)]
        overridden = [*objections, *failed]
        if overridden and not override.strip():
            kind = InstallError if objections else InstallGateError
            raise kind(
                f"{path} is not installed. {' '.join(overridden)}",
                code="objection" if objections else "",
                remedy='To override: calibrate install --override "REASON".',
                gates=len(failed),
                objections=len(objections),
            )
        if overridden:
            _require_words(override)
            taken = Override(override.strip(), who(), overridden)
            calibration = msgspec.structs.replace(calibration, override=taken)
        change = change_text(before, calibration)
        return add_version(root, calibration, "install", change, override.strip())


def rollback(root: Path | None = None, to: int | None = None, reason: str = "") -> InstalledVersion:
    """Switch back: to the calibration before the current one, or to generation `to`. As `install` does.

    `reason`: may be empty. Raises InstallError.
    """
    if reason.strip():
        _require_words(reason)
    folder = calibrations_folder(root)
    with locked(folder):
        known = installed_versions(root)
        current = next((g for g in known if g.current), None)
        if to is None:
            older = before_current(known)
            if older is None:
                raise InstallError(f"{folder}: no older calibration to go back to.", code="nothing-older")
            target = older
        else:
            target = next((g for g in known if g.number == to), None) or no_such_version(folder, to, known)
        if target.calibration is None:
            raise InstallError(
                f"InstalledVersion {target.number} is damaged and cannot be used: {target.problem}",
                code="damaged-version",
                generation=target.number,
            )
        before = None if current is None else current.calibration
        make_current(root, target, "rollback", change_text(before, target.calibration), reason)
    return InstalledVersion(target.number, target.path, True, target.calibration)


def reason_problem(reason: str) -> str:
    """Problem with a person's reason for people; empty when it is accepted."""
    if len({letter for letter in reason.casefold() if letter.isalpha()}) >= REASON_LETTERS:
        return ""
    return f"Override reason “{reason.strip()}” is too short. State the cause."


def _require_words(reason: str) -> None:
    if problem := reason_problem(reason):
        raise InstallError(f"{problem} Nothing was changed.", code="reason-too-short")


def objections_beside(calibration: Calibration, root: Path | None = None) -> list[str]:
    """Objections against following the installed one: another robot, camera or mounting, or less certain."""
    before = _installed_before(root)
    regression = _regression(calibration, before)
    return [*_objections(calibration, before, "", ""), *([regression.text] if regression else [])]


def change_text(before: Calibration | None, after: Calibration) -> str:
    """'0.120 mm, 0.0040° from the one before', lengths of δt and δφ; empty without one of the same mount."""
    if before is None or before.mount != after.mount:
        return ""
    delta = difference(after.transform.matrix, before.transform.matrix)
    degrees = float(np.degrees(np.linalg.norm(delta[3:])))
    return f"{np.linalg.norm(delta[:3]) * 1000:.3f} mm, {degrees:.4f}° from the one before"


def _installed_before(root: Path | None) -> Calibration | None:
    """The current one; where that is damaged, the newest that is whole, so that the checks still hold."""
    known = [g for g in installed_versions(root) if g.calibration is not None]
    current = [g for g in known if g.current]
    return (current or known)[-1].calibration if known else None


def install_line(source: Source, path: Path) -> str:
    """The command that installs a file of this source: only what a real cell captured goes there unasked."""
    kind = _CELL_OF[source]
    place = "" if kind == "real" else f"--cell {kind} --root FOLDER "
    return f"calibrate install {place}{shlex.quote(str(path))}"


def _refuse_foreign_source(
    calibration: Calibration, before: Calibration | None, cell: Cell, path: Path
) -> None:
    kind = _CELL_OF[calibration.source]
    if kind != cell:
        raise InstallError(
            f"{path} is {calibration.source} and is not installed on {_ARTICLE[cell]} {cell} cell.",
            code="other-cell",
            remedy=f"Files from elsewhere have their own place: {install_line(calibration.source, path)}",
            source=calibration.source,
            cell=cell,
        )
    if before is not None and _CELL_OF[before.source] != kind:
        raise InstallError(
            f"{path} ({calibration.source}) does not follow a {before.source} calibration in the same place.",
            code="other-cell",
            remedy="Use another --root.",
            source=calibration.source,
            cell=_CELL_OF[before.source],
        )


def _failed_gates(calibration: Calibration, before: Calibration | None) -> list[Gate]:
    regression = _regression(calibration, before)
    return [*calibration.quality.failed, *([regression] if regression else [])]


def _regression(calibration: Calibration, before: Calibration | None) -> Gate | None:
    """The failed gate of one much less certain than what it would replace, unless that failed its own."""
    if before is None or before.quality.failed:
        return None
    new, old = calibration.quality, before.quality
    same_place = new.working_distance_m == old.working_distance_m
    if same_place and new.predicted_error_mm is not None and old.predicted_error_mm is not None:
        ours, theirs = new.predicted_error_mm, old.predicted_error_mm
        title = f"Regression: predicted error at {1e3 * (new.working_distance_m or 0):.0f} mm"
    else:
        ours, theirs = calibration.sigma.translation_mm, before.sigma.translation_mm
        title = "Regression: standard uncertainty of the position"
    remedy = "Capture more or better poses, or keep the installed one."
    gate = Gate.measured("no_worse", title, ours / 1e3, "≤", WORSE_TIMES * theirs / 1e3, "m", remedy)
    return None if gate.passed else gate


def _objections(
    calibration: Calibration, before: Calibration | None, robot_serial: str, camera_serial: str
) -> list[str]:
    """Reasons against, other than gates: another robot or camera than the cell's."""
    devices = (("robot", robot_serial), ("camera", camera_serial))
    found = []
    for name, serial in devices:
        device = getattr(calibration, name)
        if serial and device.serial != serial:
            found.append(f"It is of {name} {device.serial or 'unknown'}, the cell has {serial}.")
    for name, _ in devices if before is not None else ():
        device, installed = getattr(calibration, name), getattr(before, name)
        if (installed.model, installed.serial) != (device.model, device.serial):
            found.append(
                f"It is of {name} {device.model} {device.serial}, the installed one of {installed.model} "
                f"{installed.serial}."
            )
    if before is not None and before.mount != calibration.mount:
        found.append(f"It is {calibration.mount}, the installed one {before.mount}.")
    return found
