"""Load the installed calibration in programs that use a camera. Needs only NumPy and PyYAML."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.errors import CalibrationError, InstallError
from calibrate.files.folders import calibrations_folder, current_version, validity_of
from calibrate.files.integrity import check_plain, read_bounded, require_content_of_name, verified_plain
from calibrate.files.validity import Validity, ValidityReason, ValidityState, require_usable, time_text
from recordings.files import MAIN_CAMERA
from recordings.geometry import Array, Transform

if TYPE_CHECKING:
    from recordings.schema.messages import CameraModel, Mount, Source

_NOT_REAL = ("simulated", "playback")


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
class InstalledCalibration:
    """Installed calibration for programs. The whole file: `read_calibration(self.path)`."""

    camera_name: str
    version: int
    path: Path
    """File of this version, which never changes."""
    validity: Validity
    plain: dict[str, Any]
    """Content of the file as plain data of today's format."""

    @cached_property
    def transform(self) -> Transform:
        """flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand), metres; the arm as it is."""
        result = self.plain["result"]
        return Transform(result["parent_frame"], result["child_frame"], np.array(result["matrix"], float))

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
    for name, serial in (("robot", robot_serial), ("camera", camera_serial)):
        own = str(found.plain[name].get("serial", ""))
        if serial and own != serial and found.validity.state is not ValidityState.WITHDRAWN:
            text = f"It is of {name} {own or 'unknown'}, there is {serial}. Calibrate the new one."
            reason = ValidityReason(f"{name}-changed", text, {"calibrated": own, "found": serial})
            doubted = replace(found.validity, state=ValidityState.IN_DOUBT, since=time_text(), reason=reason)
            found = replace(found, validity=doubted)
    if require_valid is not False:
        anyway = "require_valid=False loads it all the same"
        proven = require_valid is True
        require_usable(found.validity, str(found.path), anyway, proven=proven, camera=found.camera_name)
    return found


def _read(root: Path | str | None, camera: str) -> InstalledCalibration:
    folder = calibrations_folder(root, camera)
    number, path = current_version(folder)
    content = read_bounded(path)
    plain = verified_plain(content, str(path))
    check_plain(plain, str(path))
    require_content_of_name(path, content)
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

    Reads two small files every `poll_s` seconds, which works on any file system. Also yields when the last
    proof grows older than the cell allows. `stop_s`: seconds after which it ends; None: never. It refuses
    nothing: check `.installed.source` (simulated?) and `.installed.validity`.
    """
    folder = calibrations_folder(root, camera)
    ends_s = None if stop_s is None else time.monotonic() + stop_s
    seen = (0, "") if first else _state(folder)
    version, _ = seen
    while True:
        if (now := _state(folder)) != seen:
            seen = now
            change, version = _look(root, camera, version)
            yield change
        if ends_s is not None and time.monotonic() >= ends_s:
            return
        time.sleep(poll_s)


def _state(folder: Path) -> tuple[int, str]:
    """Version, and its validity state, since when and why; or 0 and the code of the error."""
    try:
        number, _ = current_version(folder)
        held = validity_of(folder, number)
        return number, f"{held.state} {held.since} {held.reason.code}"
    except CalibrationError as problem:
        return 0, problem.code


def _look(root: Path | str | None, camera: str, before: int) -> tuple[InstallationChange, int]:
    """The change after version `before` (0: none), and the version now."""
    try:
        now = _read(root, camera)
    except CalibrationError as problem:
        return InstallationChange("unreadable", None, problem), 0
    event = now.validity.state.value
    if now.version != before:
        event = "rolled-back" if now.version < before else "installed"
    return InstallationChange(event, now), now.version
