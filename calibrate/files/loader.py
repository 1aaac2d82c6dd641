"""Load the installed calibration in programs that use a camera. Needs only NumPy and PyYAML."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from calibrate.errors import CalibrationError, CalibrationFileError, InstallError
from calibrate.files.folders import calibrations_folder, current_version, readable_folder, validity_of
from calibrate.files.proof import check_result, proven_plain, read_bounded, refused_table
from calibrate.files.validity import (
    FILE,
    Validity,
    ValidityReason,
    ValidityState,
    parse_time,
    require_usable,
    time_text,
)
from calibrate.geometry import Array, Transform
from calibrate.kinematics import base_from_flange
from recordings.files import MAIN_CAMERA

if TYPE_CHECKING:
    from recordings.schema.messages import CameraModel, Mount, Source

_NOT_REAL = ("simulated", "playback")


@dataclass(frozen=True)
class InstalledDevice:
    model: str
    serial: str


@dataclass(frozen=True, eq=False)
class InstalledLens:
    """Intrinsics. Pixel (0, 0) is the centre of the top left pixel, as in OpenCV."""

    width: int
    height: int
    matrix: Array
    """(3, 3), pixels"""
    distortion: Array
    """(n,), as OpenCV orders them"""
    distortion_model: str

    @property
    def model(self) -> CameraModel:
        """Convert to the `CameraModel` that `calibrate` and `recordings` use."""
        from recordings.schema.messages import CameraModel

        rows = tuple(tuple(row) for row in self.matrix.tolist())
        return CameraModel(
            self.width,
            self.height,
            rows,
            tuple(self.distortion.tolist()),
            self.distortion_model,  # type: ignore[arg-type]  # one of its literals, by the hash of the file
        )


@dataclass(frozen=True, eq=False)
class InstalledArm:
    """The arm's corrected table with the X that belongs to it; use neither without the other."""

    transform: Transform
    """corrected_flange_from_camera (eye-in-hand) or corrected_base_from_camera (eye-to-hand), metres."""
    table: dict[str, list[float]]
    """a_m, d_m, alpha_rad, theta_rad, beta_rad: see `calibrate.kinematics`."""

    def base_from_flange(self, joints_rad: ArrayLike) -> Transform:
        """Compute corrected_base_from_corrected_flange, metres, of joints (6,), radians."""
        return Transform("corrected_base", "corrected_flange", base_from_flange(self.table, joints_rad))


@dataclass(frozen=True, eq=False)
class InstalledCalibration:
    """Installed calibration for programs. The whole file: `read_calibration(self.path)`."""

    camera_name: str
    version: int
    path: Path
    """File of this version, which never changes."""
    validity: Validity
    plain: dict[str, Any]
    """Content of the file as plain data."""

    @cached_property
    def transform(self) -> Transform:
        """flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand), metres; the arm as it is."""
        result = self.plain["result"]
        return Transform(result["parent_frame"], result["child_frame"], np.array(result["matrix"], float))

    @cached_property
    def corrected_arm(self) -> InstalledArm:
        """Return the arm's corrected table with its X. CalibrationFileError if none is offered."""
        found = self.plain.get("arm_table") or {"refused": "the arm's model is not known"}
        if not found.get("offered"):
            raise refused_table(str(found.get("refused", "")))
        result = found["result"]
        return InstalledArm(
            Transform(result["parent_frame"], result["child_frame"], np.array(result["matrix"], float)),
            found["corrected"],
        )

    @cached_property
    def covariance(self) -> Array:
        """Covariance (6, 6) of δt (m), δφ (rad), both in the parent frame."""
        return np.array(self.plain["covariance"], float)

    @cached_property
    def intrinsics(self) -> InstalledLens:
        """Intrinsics that X was estimated with; use the two together."""
        lens = self.plain["intrinsics"]
        matrix, distortion = (np.array(lens[key], float) for key in ("matrix", "distortion"))
        return InstalledLens(lens["width"], lens["height"], matrix, distortion, lens["distortion_model"])

    @property
    def mount(self) -> Mount:
        mount: Mount = self.plain["mount"]
        return mount

    @property
    def source(self) -> Source:
        source: Source = self.plain["source"]
        return source

    @property
    def created(self) -> str:
        """Time of the solve, UTC."""
        return str(self.plain["created"])

    @property
    def robot(self) -> InstalledDevice:
        return self._device("robot")

    @property
    def camera(self) -> InstalledDevice:
        return self._device("camera")

    def _device(self, name: str) -> InstalledDevice:
        found = self.plain[name]
        return InstalledDevice(str(found.get("model", "")), str(found.get("serial", "")))

    @property
    def age_s(self) -> float:
        """Seconds since the last proof: the views it was solved from, or a check that passed."""
        proven = parse_time(self.validity.verified) or parse_time(self.created)
        return float("nan") if proven is None else (datetime.now(UTC) - proven).total_seconds()


def load_installed(
    root: Path | str | None = None,
    allow_simulated: bool = False,
    *,
    camera: str = MAIN_CAMERA,
    require_valid: bool | None = None,
    robot_serial: str = "",
    camera_serial: str = "",
) -> InstalledCalibration:
    """Load the installed calibration of `camera`, verified by its hash: the function for programs to call.

    `.validity` says whether it still holds. `require_valid`: None refuses one in doubt or withdrawn, True
    also an unverified one, False none. `robot_serial`, `camera_serial`: of the devices in use; if they differ
    from the calibration's, it is in doubt for this call.

    Raises InstallError when nothing is installed (`nothing-installed`), when it is not of a real cell and
    `allow_simulated` is False (`not-real`), when its validity is refused (`calibration-in-doubt`,
    `calibration-unverified`, `calibration-withdrawn`); CalibrationFileError when it is damaged.
    """
    found = _read(root, camera)
    if found.source in _NOT_REAL and not allow_simulated:
        raise InstallError("not-real", path=found.path, source=found.source)
    for name, serial, device in (
        ("robot", robot_serial, found.robot),
        ("camera", camera_serial, found.camera),
    ):
        if serial and device.serial != serial:
            text = f"It is of {name} {device.serial or 'unknown'}, there is {serial}. Calibrate the new one."
            reason = ValidityReason(f"{name}-changed", text, {"calibrated": device.serial, "found": serial})
            doubt = ValidityState.IN_DOUBT
            if found.validity.state is not ValidityState.WITHDRAWN:
                found = replace(
                    found,
                    validity=replace(found.validity, state=doubt, since=time_text(), reason=reason),
                )
    if require_valid is not False:
        anyway = "require_valid=False loads it all the same"
        proven = require_valid is True
        require_usable(found.validity, str(found.path), anyway, proven=proven, camera=found.camera_name)
    return found


def _read(root: Path | str | None, camera: str) -> InstalledCalibration:
    folder = readable_folder(root, camera)
    number, path = current_version(folder)
    plain = proven_plain(read_bounded(path), str(path))
    try:
        check_result(plain, str(path))
    except (KeyError, TypeError, ValueError) as problem:
        raise CalibrationFileError(
            "contradiction", path=path, why=f"{problem} is missing or of another kind"
        ) from None
    return InstalledCalibration(camera, number, path, validity_of(folder, number), plain)


# --- changes ---
@dataclass(frozen=True, eq=False)
class InstallationChange:
    """Change of a camera's installed calibration."""

    event: str
    """installed, rolled-back, valid, unverified, in-doubt, withdrawn, or unreadable"""
    installed: InstalledCalibration | None
    problem: CalibrationError | None = None
    """Why it is unreadable."""


def watch(
    root: Path | str | None = None,
    *,
    camera: str = MAIN_CAMERA,
    poll_s: float = 1.0,
    stop_s: float | None = None,
    first: bool = False,
) -> Iterator[InstallationChange]:
    """Yield every change of the installed calibration of `camera`: install, rollback, change of validity.

    `first`: begin with what is installed now, so that nothing is missed between loading and watching.

    Polls the times of two files every `poll_s` seconds, which works on any file system. Also yields when
    the last proof grows too old by the cell's rule. `stop_s`: seconds after which it ends; None: never.
    Nothing is refused, simulated ones neither: check `.installed.source` and `.installed.validity`.
    """
    folder = calibrations_folder(root, camera)
    ends_s = None if stop_s is None else time.monotonic() + stop_s
    marks = _marks(folder)  # before reading, so that a change in between is seen at the next poll
    before = _look(root, camera, None)
    if first:
        yield before
    while ends_s is None or time.monotonic() < ends_s:
        time.sleep(poll_s)
        seen = _marks(folder)
        held = None if before.installed is None else before.installed.validity
        ages = held is not None and held.at(datetime.now(UTC)).state is not held.state
        if seen == marks and not ages:
            continue
        marks, now = seen, _look(root, camera, before)
        if _key(now) != _key(before):
            yield now
        before = now


def _marks(folder: Path) -> list[int]:
    """Read the modification times of `current` and of the validity file; 0 where there is none."""
    marks = []
    for name in ("current", FILE):
        try:
            marks.append((folder / name).lstat().st_mtime_ns)
        except OSError:
            marks.append(0)
    return marks


def _look(root: Path | str | None, camera: str, before: InstallationChange | None) -> InstallationChange:
    try:
        now = _read(root, camera)
    except CalibrationError as problem:
        return InstallationChange("unreadable", None, problem)
    was = None if before is None else before.installed
    if was is None or now.version != was.version:
        older = was is not None and now.version < was.version
        return InstallationChange("rolled-back" if older else "installed", now)
    return InstallationChange(now.validity.state.value, now)


def _key(change: InstallationChange) -> tuple[object, ...]:
    if change.installed is None:
        return (None if change.problem is None else change.problem.code,)
    validity = change.installed.validity
    return change.installed.version, validity.state, validity.since, validity.reason.code
