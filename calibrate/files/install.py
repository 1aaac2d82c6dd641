"""Install a calibration, roll back, withdraw, and record its validity. The folder: see `versions`."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, get_args

import msgspec
import numpy as np

from calibrate.errors import (
    CalibrationError,
    GateFailedError,
    InstallError,
    UsageError,
    require_choice,
    require_positive,
)
from calibrate.files.calibration import Calibration, Override, read_calibration
from calibrate.files.folders import (
    calibrations_folder,
    current_version,
)
from calibrate.files.touch import agrees, touch_text
from calibrate.files.validity import LOG_DAMAGED, Validity, ValidityReason, ValidityState, time_text
from calibrate.files.validity_log import read_validity_log
from calibrate.files.validity_writer import append_to_log
from calibrate.files.versions import (
    InstalledVersion,
    add_version,
    before_current,
    installed_versions,
    locked,
    make_current,
    read_log,
    version_numbers,
    who,
)
from calibrate.handeye.metrics import point_error_m
from calibrate.results import Gate
from recordings.files import MAIN_CAMERA
from recordings.geometry import difference
from recordings.schema.messages import Source

Cell = Literal["real", "imported", "simulated"]
_CELL_OF: dict[Source, Cell] = {
    "real": "real",
    "imported": "imported",
    "simulated": "simulated",
    "playback": "simulated",
}

WORSE_TIMES = 1.5
"""Ratio of predicted errors above which a new calibration counts as worse, not different by chance."""
REASON_LETTERS = 5
"""Fewest different letters of a reason, in any script: fewer may be a key that was held down."""


def installed_calibration(root: Path | None = None, camera: str = MAIN_CAMERA) -> Calibration:
    """Read the whole installed calibration file, whatever its source and validity.

    Raises InstallError when nothing is installed, CalibrationFileError when it is damaged. Programs that use
    the camera should call `load_installed`, which checks both.
    """
    return read_calibration(current_version(calibrations_folder(root, camera))[1])


def install(
    path: Path,
    root: Path | None = None,
    *,
    cell: Cell = "real",
    camera: str = "",
    override: str = "",
    max_age_days: float | None = None,
    by: str = "",
) -> InstalledVersion:
    """Make the calibration file `path` the current one of its camera.

    `cell`: kind of cell that this root belongs to; a real one refuses what is simulated, played back or
    imported, whatever the override. `camera`: its name in the cell; empty: as in the file.
    `override`: a person's reason to install although a gate failed or robot or camera differ; it goes into
    the file. `max_age_days`: age of the last proof from which it is in doubt; None: the rule of the one
    before, 0: no rule. `by`: who installs it, for the log and the file; empty: the user of this process.

    Raises InstallError (also as exit code 4 for a gate) or CalibrationFileError.
    """
    require_choice("cell", cell, get_args(Cell))
    require_positive(max_age_days=max_age_days or None)  # 0: no limit
    calibration = read_calibration(path)
    name = camera or calibration.camera_name
    folder = calibrations_folder(root, name)
    with locked(folder):
        before, objections, worse = _beside(calibration, root, name)
        kinds = {cell} if before is None else {cell, _CELL_OF[before.source]}
        if other := kinds - {_CELL_OF[calibration.source]}:
            raise InstallError(
                "other-cell",
                path=path,
                source=calibration.source,
                cell=other.pop(),
                command=install_line(calibration.source, path, camera=camera),
            )
        failed = [f"{gate.name}: {gate.text}" for gate in (*calibration.quality.failed, *worse)]
        overridden = [*objections, *failed]
        if overridden and not override.strip():
            kind = InstallError if objections else GateFailedError
            raise kind(
                "objection" if objections else "gate-failed",
                path=path,
                why=" ".join(overridden),
                command=install_line(calibration.source, path, root, "REASON", camera),
                gates=len(failed),
                objections=len(objections),
            )
        if overridden:
            _require_words(override)
            taken = Override(override.strip(), by or who(), overridden)
            calibration = msgspec.structs.replace(calibration, override=taken)
        change = "" if _is_withdrawn(folder) else change_text(before, calibration)
        validity = _first_validity(calibration, _max_age_days(folder, max_age_days), by or who())
        return add_version(folder, calibration, "install", validity, change, override.strip(), by=by)


def _is_withdrawn(folder: Path) -> bool:
    """Tell whether what is installed was taken out of use; False where nothing is, or it is damaged."""
    try:
        number, _ = current_version(folder)
    except CalibrationError:
        return False
    return read_validity_log(folder).of(number).state is ValidityState.WITHDRAWN


def _first_validity(calibration: Calibration, max_age_days: float | None, by: str) -> Validity:
    """Choose the validity of a new installation: valid, unless it is imported or overridden."""
    state, reason = ValidityState.UNVERIFIED, ValidityReason("installed")
    if calibration.source == "imported":
        text = "Images and poses are of unknown origin. Check it in the cell."
        reason = ValidityReason("imported", text)
    elif calibration.override is not None:
        reason = ValidityReason("override", f"Installed by override: {calibration.override.reason}")
    else:
        state = ValidityState.VALID
    recorded_ns = calibration.provenance.recorded_wall_ns
    proven = time_text(datetime.fromtimestamp(recorded_ns / 1e9, UTC)) if recorded_ns else calibration.created
    return Validity(0, state, time_text(), reason, by, proven, max_age_days)


def _max_age_days(folder: Path, asked: float | None) -> float | None:
    """Return the oldest age of the last proof that is allowed: `asked`, else as for the version before."""
    if asked is not None:
        return asked or None
    log = read_validity_log(folder)
    return log.of(max(log.last)).max_age_days if log.last else None


def rollback(
    root: Path | None = None,
    to: int | None = None,
    reason: str = "",
    *,
    camera: str = MAIN_CAMERA,
    override: str = "",
    by: str = "",
    seen: int | None = None,
) -> InstalledVersion:
    """Make the calibration before the current one, or version `to`, the current one again.

    It is unverified until a check passes, or in doubt if it was before. `reason`: may be empty. `override`: a
    person's reason why version `to` may be used although a damaged line of the log may have withdrawn it
    (`log-damaged`); it goes into the log. `by`: who asks for it, for the log; empty: the user of this
    process. `seen`: the version that a person saw installed. Raises InstallError: `other-version` where
    another one is by now.
    """
    for given in (reason, override):
        if given.strip():
            _require_words(given)
    if override.strip() and to is None:
        raise UsageError("override-without-version")
    folder = calibrations_folder(root, camera)
    if to is None:
        current_version(folder)  # raises first, so that no folder is created in vain
    with locked(folder):
        if seen is not None:
            _require_current(folder, seen)
        known = installed_versions(root, camera)
        if to is None:
            target = before_current(known, read_log(root, camera))
            if target is None:
                raise InstallError("nothing-older", folder=folder, command=undo_line(root, camera))
        else:
            target = next((g for g in known if g.number == to), None)
        if target is None:
            have = ", ".join(str(g.number) for g in known) or "none"
            raise InstallError("no-such-version", folder=folder, generation=to, have=have)
        if target.calibration is None:
            raise InstallError("damaged-version", generation=target.number, why=target.problem)
        before = next((g.calibration for g in known if g.current), None)
        change = change_text(before, target.calibration)
        recorded = read_validity_log(folder).of(target.number)
        was = replace(recorded, max_age_days=_max_age_days(folder, None))
        validity = _validity_again(was, target.current, override.strip(), by or who())
        said = reason or override.strip()
        return make_current(folder, replace(target, validity=validity), "rollback", change, said, by=by)


def withdraw(
    root: Path | None,
    reason: str,
    *,
    camera: str = MAIN_CAMERA,
    by: str = "",
    seen: int | None = None,
) -> Validity:
    """Take the installed calibration out of use. `by`, `seen`: as for `rollback`.

    Raises InstallError, also for an empty reason.
    """
    _require_words(reason)
    cause = ValidityReason("withdrawn", reason.strip())
    return set_validity(root, ValidityState.WITHDRAWN, cause, camera=camera, version=seen, by=by)


def undo_line(root: Path | None = None, camera: str = MAIN_CAMERA) -> str:
    """Make the command that undoes the last installation: a rollback, or withdrawal where there is none."""
    older = before_current(installed_versions(root, camera), read_log(root, camera))
    other = "" if camera == MAIN_CAMERA else camera
    return _line(root, other, *(["rollback"] if older else ["withdraw", "REASON"]))


def _line(root: Path | None, camera: str, *words: str) -> str:
    where = [] if root is None else ["--root", str(root)]
    named = ["--camera", camera] if camera else []
    return shlex.join(["calibrate", *words, *where, *named])


def _validity_again(was: Validity, current: bool, override: str, by: str) -> Validity:
    """Choose the validity of a version after a rollback: it was not checked while it was not current."""
    if was.reason.code == LOG_DAMAGED and override:
        reason = ValidityReason("override", f"In spite of a damaged log: {override}")
    elif was.state is ValidityState.IN_DOUBT or current:
        return was
    else:
        reason = ValidityReason("rolled-back", "Rolled back to. Run a drift check.")
    return replace(was, state=ValidityState.UNVERIFIED, since=time_text(), reason=reason, who=by)


def set_validity(
    root: Path | None,
    state: ValidityState,
    reason: ValidityReason,
    *,
    camera: str = MAIN_CAMERA,
    version: int | None = None,
    by: str = "",
) -> Validity:
    """Record that the installed calibration of `camera` is valid, unverified, in doubt or withdrawn, and why.

    `version`: the one that was judged. `by`: who says so; empty: the user of this process. VALID makes now
    the time of the last proof. A doubt by `log-damaged` stays unless it is withdrawn: a person ends it with
    `rollback`. Raises InstallError: `other-version` where another one is installed by now,
    `nothing-installed` where none is.
    """
    require_choice("state", state, ValidityState)
    state, now = ValidityState(state), time_text()

    def change(before: Validity) -> Validity:
        if before.reason.code == LOG_DAMAGED and state is not ValidityState.WITHDRAWN:
            return before
        since = before.since if before.state is state else now
        verified = now if state is ValidityState.VALID else before.verified
        return replace(before, state=state, since=since, reason=reason, who=by or who(), verified=verified)

    return _change_validity(root, camera, version, change)


def note_check(
    root: Path | None,
    reason: ValidityReason,
    passed: bool,
    proves: bool,
    when: datetime,
    *,
    camera: str = MAIN_CAMERA,
    version: int | None = None,
) -> Validity:
    """Record the validity after a check, by the rules of `Validity.after_check`; else as `set_validity`."""
    return _change_validity(
        root, camera, version, lambda v: v.after_check(reason, passed, proves, when, who())
    )


def _change_validity(
    root: Path | None, camera: str, version: int | None, change: Callable[[Validity], Validity]
) -> Validity:
    folder = calibrations_folder(root, camera)
    current_version(folder)  # raises first, so that no folder is created in vain
    with locked(folder):
        number = current_version(folder)[0] if version is None else _require_current(folder, version)
        before = read_validity_log(folder).of(number)
        after = change(before)
        if after != before:
            append_to_log(folder, after, version_numbers(folder))
    return after.at(datetime.now(UTC))


def _require_current(folder: Path, seen: int) -> int:
    """Return the number of the installed version. InstallError where it is another than a person saw."""
    number, _ = current_version(folder)
    if number != seen:
        raise InstallError("other-version", folder=folder, version=number, judged=seen)
    return number


def reason_problem(reason: str) -> str:
    """Say what is wrong with a person's reason; empty when it is accepted."""
    if len({letter for letter in reason.casefold() if letter.isalpha()}) >= REASON_LETTERS:
        return ""
    return "Say why, in a few words."


def _require_words(reason: str) -> None:
    if reason_problem(reason):
        raise InstallError("reason-too-short")


def objections_beside(
    calibration: Calibration, root: Path | None = None, known: Sequence[InstalledVersion] | None = None
) -> list[str]:
    """List what installing asks a reason for, besides failed gates, as `_beside` finds it.

    `known`: the installed versions of its camera, where they were read already.
    """
    _, objections, worse = _beside(calibration, root, calibration.camera_name, known)
    return [*objections, *(gate.text for gate in worse)]


def change_text(before: Calibration | None, after: Calibration) -> str:
    """Write '0.120 mm, 0.0040° (1.3σ) from the one before'; empty without one of the same mounting before.

    Sigmas: Mahalanobis distance with the sum of both covariances, as if the two were independent.
    """
    if before is None or before.mount != after.mount:
        return ""
    delta = difference(after.transform.matrix, before.transform.matrix)
    millimetres, degrees = 1e3 * np.linalg.norm(delta[:3]), np.degrees(np.linalg.norm(delta[3:]))
    covariance = np.array(before.covariance) + np.array(after.covariance)
    sigmas = float(np.sqrt(delta @ np.linalg.pinv(covariance, hermitian=True) @ delta))
    return f"{millimetres:.3f} mm, {degrees:.4f}° ({sigmas:.1f}σ) from the one before"


def _beside(
    calibration: Calibration,
    root: Path | None,
    camera: str,
    versions: Sequence[InstalledVersion] | None = None,
) -> tuple[Calibration | None, list[str], list[Gate]]:
    """Compare a calibration with the installed one, or the newest undamaged one.

    That one, objections (another robot, camera or mounting, a missed touch test), and a failed gate where it
    is much less certain. A withdrawn one is no measure of how certain a calibration should be.
    """
    if versions is None:
        versions = installed_versions(root, camera)
    known = [g for g in versions if g.calibration is not None]
    current = [g for g in known if g.current]
    before = (current or known)[-1].calibration if known else None
    found = []
    if not current and (calibrations_folder(root, camera) / "current").is_symlink():
        found.append("The installed one is damaged: this one was not compared with it.")
    if before is not None:
        for name in ("robot", "camera"):
            ours, theirs = getattr(calibration, name), getattr(before, name)
            if (ours.model, ours.serial) != (theirs.model, theirs.serial):
                installed = f"the installed one of {theirs.model} {theirs.serial}."
                found.append(f"It is of {name} {ours.model} {ours.serial}, {installed}")
        if before.mount != calibration.mount:
            found.append(f"It is {calibration.mount}, the installed one {before.mount}.")
    if not calibration.intrinsics.matrix:
        found.append("It was made without pictures: no gate judged them, and the lens is not known.")
    if calibration.camera.name not in ("", camera):
        found.append(f"It is of the camera named {calibration.camera.name}, not {camera}.")
    found += _excluded(calibration)
    found += [f"Touch test, {touch_text(t)}." for t in calibration.verification if not agrees(t)]
    withdrawn = bool(current) and current[-1].validity.state is ValidityState.WITHDRAWN
    return before, found, [] if withdrawn else _regression(calibration, before)


def _excluded(calibration: Calibration) -> Iterator[str]:
    """Yield what speaks against it of the views that a person excluded."""
    count = len(calibration.excluded_views)
    if calibration.excluded_too_many:
        recorded = len(calibration.views.used) + len(calibration.views.rejected)
        yield f"A person excluded {count} of {recorded} views, more than a fifth."
    if calibration.passes_only_without and calibration.excluded is not None:
        failed = ", ".join(calibration.excluded.all_views.failed)
        said = f"fail: {failed}" if failed else "give no result"
        left_out = "the view" if count == 1 else f"the {count} views"
        yield f"It passes only without {left_out} that a person excluded. All views together {said}."


def install_line(
    source: Source, path: Path, root: Path | None = None, override: str = "", camera: str = ""
) -> str:
    """Make the command that installs a file of this source; only real ones go to the default root."""
    words = ["install", str(path)]
    if (kind := _CELL_OF[source]) != "real":
        words, root = [*words, "--cell", kind], root or Path("ROOT")
    return _line(root, camera, *words, *(["--override", override] if override else []))


def _error_of_X_m(calibration: Calibration, distance_m: float) -> float:
    """Predict the error, metres, of a point so far from the camera by X alone."""
    return point_error_m(calibration.transform.matrix, np.array(calibration.covariance), distance_m)


def _placed_error_m(calibration: Calibration, distance_m: float) -> float:
    """Predict the error, metres, of a placed point at another distance than that for which it is stated.

    X's part grows with the distance; the rest, the arm's, stays.
    """
    point = calibration.quality.point
    assert point is not None
    stated = (1e-3 * point.error_mm) ** 2
    rest = max(stated - _error_of_X_m(calibration, point.at_m) ** 2, 0.0)
    return math.sqrt(rest + _error_of_X_m(calibration, distance_m) ** 2)


def _regression(calibration: Calibration, before: Calibration | None) -> list[Gate]:
    """Make a failed gate where a point is placed much worse than by the calibration that is replaced.

    Where one of them does not state that, the errors of X alone are compared. Empty where the replaced one
    failed its own gates.
    """
    if before is None or before.quality.failed:
        return []
    distance_m = calibration.quality.working_distance_m or 0.0
    both_placed = calibration.quality.point is not None and before.quality.point is not None
    error_m = _placed_error_m if both_placed else _error_of_X_m
    ours, theirs = error_m(calibration, distance_m), error_m(before, distance_m)
    what = "placed-point error" if both_placed else "error of X"
    title = f"Regression: {what} at {1e3 * distance_m:.0f} mm"
    remedy = "Capture more or better poses, or keep the installed one."
    if len({one.provenance.software.get("calibration-station") for one in (calibration, before)}) > 1:
        remedy += " Its error was stated by another version: solve its recording again to compare."
    gate = Gate.measured("no_worse", title, ours, "≤", WORSE_TIMES * theirs, "m", remedy)
    return [] if gate.passed else [gate]
