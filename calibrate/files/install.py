"""Installing a calibration, who refuses it and why, loading it in other programs, and the way back.

How it lies on the disk is `generations`' business.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from calibrate.errors import GateFailedError
from calibrate.files.calibration import Calibration, Override, read_calibration
from calibrate.files.generations import (
    Generation,
    InstallError,
    add_generation,
    before_current,
    calibrations_folder,
    generations,
    locked,
    make_current,
    no_generation,
    readable_folder,
    who,
)
from calibrate.files.verification import objections as by_hand
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
    """A gate failed and nobody took responsibility."""


def load_installed(root: Path | None = None, allow_simulated: bool = False) -> Calibration:
    """The installed calibration, verified: the call for programs that use the camera.

    `calibration.transform` is `flange_from_camera` (eye-in-hand) or `base_from_camera` (eye-to-hand), with
    both frame names in it; `calibration.intrinsics.model` is the lens. Raises InstallError when nothing is
    installed or when it is simulated and that was not asked for, CalibrationFileError when it is damaged.
    """
    current = readable_folder(root) / "current"
    if not current.exists():
        raise InstallError(f"{current}: nothing is installed. Run: calibrate install FILE")
    calibration = read_calibration(current)
    if _CELL_OF[calibration.source] == "simulated" and not allow_simulated:
        raise InstallError(
            f"{current}: the installed calibration is {calibration.source}, not of a real cell."
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
) -> Generation:
    """Makes the calibration file `path` the current one.

    `cell`: what kind of cell this root belongs to; a real one takes nothing simulated, played back or
    imported, and no override changes that. `override`: a person's reason to install although a gate failed
    or robot or camera differ; it goes into the file. `robot_serial`, `camera_serial`: of the cell's own
    configuration, when known. Raises InstallError (also as exit code 4 for a gate) or CalibrationFileError.
    """
    calibration = read_calibration(path)
    with locked(calibrations_folder(root)):
        before = _installed_before(root)
        objections = _objections(calibration, before, robot_serial, camera_serial)
        objections += by_hand(calibration)
        _refuse_foreign_source(calibration, before, cell, path)
        failed = [f"gate {gate.name}: {gate.text}" for gate in calibration.quality.failed]
        failed += _worse(calibration, before)
        if (failed or objections) and not override.strip():
            kind = InstallGateError if failed and not objections else InstallError
            raise kind(
                f"{path} is not installed. " + " ".join([*objections, *failed]) + " If a person takes "
                'responsibility: calibrate install --override "REASON".'
            )
        if failed or objections:
            _require_words(override)
            taken = Override(override.strip(), who(), [*objections, *failed])
            calibration = msgspec.structs.replace(calibration, override=taken)
        change = change_text(before, calibration)
        return add_generation(root, calibration, "install", change, override.strip())


def rollback(root: Path | None = None, to: int | None = None, reason: str = "") -> Generation:
    """Switches back: to the calibration before the current one, or to generation `to`. As `install` does.

    `reason`: may be empty. Raises InstallError.
    """
    if reason.strip():
        _require_words(reason)
    folder = calibrations_folder(root)
    with locked(folder):
        known = generations(root)
        current = next((g for g in known if g.current), None)
        if to is None:
            older = before_current(known)
            if older is None:
                raise InstallError(f"{folder}: there is no older calibration to go back to.")
            target = older
        else:
            target = next((g for g in known if g.number == to), None) or no_generation(folder, to, known)
        if target.calibration is None:
            raise InstallError(f"generation {target.number} is damaged and cannot be used: {target.problem}")
        before = None if current is None else current.calibration
        make_current(root, target, "rollback", change_text(before, target.calibration), reason)
    return Generation(target.number, target.path, True, target.calibration)


def reason_problem(reason: str) -> str:
    """Why this is no reason that a person may give; empty when it is one."""
    if len({letter for letter in reason.casefold() if letter.isalpha()}) >= REASON_LETTERS:
        return ""
    return f"“{reason.strip()}” is no reason: say in words why, so that it is understood in a year."


def _require_words(reason: str) -> None:
    if problem := reason_problem(reason):
        raise InstallError(f"{problem} Nothing was changed.")


def objections_beside(calibration: Calibration, root: Path | None = None) -> list[str]:
    """What else than its gates and checks by hand makes `install` ask for a reason: the installed one.

    Another robot, camera or mount than that, or much less certain.
    """
    before = _installed_before(root)
    return [*_objections(calibration, before, "", ""), *_worse(calibration, before)]


def change_text(before: Calibration | None, after: Calibration) -> str:
    """'0.120 mm, 0.0040° from the one before', lengths of δt and δφ; empty without one of the same mount."""
    if before is None or before.mount != after.mount:
        return ""
    delta = difference(after.transform.matrix, before.transform.matrix)
    degrees = float(np.degrees(np.linalg.norm(delta[3:])))
    return f"{np.linalg.norm(delta[:3]) * 1000:.3f} mm, {degrees:.4f}° from the one before"


def _installed_before(root: Path | None) -> Calibration | None:
    """The current one; where that is damaged, the newest that is whole, so that the checks still hold."""
    known = [g for g in generations(root) if g.calibration is not None]
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
        hint = {
            "real": "A real cell takes only what was captured on it.",
            "imported": "This root is for imported recordings.",
            "simulated": "This root belongs to a simulated cell.",
        }[cell]
        raise InstallError(
            f"{path} is {calibration.source} and is not installed on {_ARTICLE[cell]} {cell} cell. {hint} "
            f"Files from elsewhere have their own place: {install_line(calibration.source, path)}"
        )
    if before is not None and _CELL_OF[before.source] != kind:
        raise InstallError(
            f"{path} ({calibration.source}) does not follow a {before.source} calibration in the same place. "
            "Use another --root."
        )


def _worse(calibration: Calibration, before: Calibration | None) -> list[str]:
    """That it is much less certain than what it would replace; unless that failed its own gates."""
    if before is None or before.quality.failed:
        return []
    new, old = calibration.quality, before.quality
    same_place = new.working_distance_m == old.working_distance_m
    if same_place and new.predicted_error_mm is not None and old.predicted_error_mm is not None:
        ours, theirs = new.predicted_error_mm, old.predicted_error_mm
        what = f"a point at {1000 * (new.working_distance_m or 0):.0f} mm is expected to be off by"
    else:
        ours, theirs = calibration.sigma.translation_mm, before.sigma.translation_mm
        what = "the camera's position is uncertain by"
    if not ours > WORSE_TIMES * theirs:
        return []
    text = (
        f"gate no worse: {what} {ours:.2f} mm (1σ), by the installed calibration {theirs:.2f} mm. Capture "
        "more or better poses, or keep the installed one; `calibrate check` says whether that still holds."
    )
    return [text]


def _objections(
    calibration: Calibration, before: Calibration | None, robot_serial: str, camera_serial: str
) -> list[str]:
    """Reasons against, other than gates: another robot or camera than the cell's."""
    robot, camera = calibration.robot, calibration.camera
    found = []
    if robot_serial and robot.serial != robot_serial:
        found.append(f"It is of robot {robot.serial or 'unknown'}, the cell has {robot_serial}.")
    if camera_serial and camera.serial != camera_serial:
        found.append(f"It is of camera {camera.serial or 'unknown'}, the cell has {camera_serial}.")
    if before is not None:
        if (before.robot.model, before.robot.serial) != (robot.model, robot.serial):
            found.append(
                f"It is of robot {robot.model} {robot.serial}, the installed one of {before.robot.model} "
                f"{before.robot.serial}."
            )
        if (before.camera.model, before.camera.serial) != (camera.model, camera.serial):
            found.append(
                f"It is of camera {camera.model} {camera.serial}, the installed one of {before.camera.model} "
                f"{before.camera.serial}."
            )
        if before.mount != calibration.mount:
            found.append(f"It is {calibration.mount}, the installed one {before.mount}.")
    return found
