"""The installed calibration for programs that use a camera. NumPy and PyYAML are enough here.

ROOT/calibrations/                  camera `main`: its versions, `current`, logs and validity
ROOT/calibrations/cameras/NAME/     the same for every other camera of the cell
"""

from __future__ import annotations

import hashlib
import re
import shlex
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from json.encoder import encode_basestring
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from calibrate.errors import CalibrationError, CalibrationFileError, InstallError
from calibrate.files.validity import (
    FILE,
    Validity,
    ValidityReason,
    ValidityState,
    parse_time,
    read_validity,
    time_text,
    unrecorded,
    validity_text,
)
from calibrate.geometry import Array, Transform, is_rigid, skew
from calibrate.kinematics import TABLE_COLUMNS, base_from_flange
from recordings import strict_yaml
from recordings.files import MAIN_CAMERA, is_session_name, state_root

if TYPE_CHECKING:
    from recordings.schema.messages import CameraModel, Mount, Source

FORMAT_NAME = "handeye-calibration/1"
VERSION_NAME = re.compile(r"(\d{4,})-[0-9a-f]{8}\.yaml")
_MCAP = b"\x89MCAP"
_LIMIT_BYTES = 4 * 1024 * 1024
_NOT_REAL = ("simulated", "playback")


# --- where calibrations lie ---
def calibrations_folder(root: Path | None, camera: str = MAIN_CAMERA) -> Path:
    """Folder of one camera's installed calibrations. InstallError for what is no name of a camera."""
    if not is_session_name(camera):
        raise InstallError(
            f"{camera!r} is no name of a camera.", code="camera-name", remedy="Use 1 to 40 of a-z, 0-9 and -."
        )
    folder = state_root(root) / "calibrations"
    return folder if camera == MAIN_CAMERA else folder / "cameras" / camera


def readable_folder(root: Path | None, camera: str = MAIN_CAMERA) -> Path:
    """Folder of the calibrations; InstallError where it may not be looked into."""
    folder = calibrations_folder(root, camera)
    try:
        (folder / "gen").exists()
    except PermissionError as problem:
        raise InstallError(
            f"{folder}: {problem.strerror}.",
            code="state-folder",
            remedy="Name another state folder with --root.",
        ) from None
    return folder


def cameras(root: Path | None = None) -> list[str]:
    """Names of the cameras for which something was ever installed below `root`, `main` first."""
    folder = readable_folder(root)
    others = sorted(path.parent.name for path in (folder / "cameras").glob("*/gen"))
    return [*([MAIN_CAMERA] if (folder / "gen").is_dir() else []), *filter(is_session_name, others)]


def current_version(folder: Path) -> tuple[int, Path]:
    """(number, file) of what `current` points to. InstallError when nothing is installed."""
    try:
        name = (folder / "current").readlink().name
    except OSError:
        name = ""
    match = VERSION_NAME.fullmatch(name)
    if match is None:
        raise InstallError(
            f"{folder / 'current'}: nothing is installed.",
            code="nothing-installed",
            remedy="Run: calibrate install FILE",
        )
    return int(match[1]), folder / "gen" / name


def current_validity(folder: Path, now: datetime | None = None) -> Validity:
    """Validity of what is installed there, at `now` (default: this moment). InstallError when nothing is."""
    return _validity_of(folder, current_version(folder)[0], now)


def _validity_of(folder: Path, number: int, now: datetime | None = None) -> Validity:
    """Of one version: what is current may change while it is read."""
    try:
        installed = datetime.fromtimestamp((folder / "current").lstat().st_mtime, UTC)
        found = read_validity(folder).get(number) or unrecorded(number, time_text(installed))
    except OSError as problem:
        raise InstallError(
            f"{problem.filename or folder}: {problem.strerror}. Its validity is not known.",
            code="state-folder",
        ) from None
    return found.at(now or datetime.now(UTC))


# --- what lies there ---
def read_bounded(path: Path) -> bytes:
    """The file's content, one byte over the limit at most. CalibrationFileError where it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(_LIMIT_BYTES + 1)
    except OSError as problem:
        raise CalibrationFileError(f"{path}: {problem.strerror or problem}.") from None


def proven_plain(content: bytes, where: str) -> dict[str, Any]:
    """A calibration file's plain data without `sha256`: hash and result are proven.

    CalibrationFileError says what is wrong.
    """
    if content.startswith(_MCAP):
        raise CalibrationFileError(
            f"{where} is a recording, no calibration file.",
            code="not-a-calibration",
            remedy=f"First run: calibrate solve {shlex.quote(where)}",
        )
    if len(content) > _LIMIT_BYTES:
        raise CalibrationFileError(
            f"{where}: larger than any calibration file.",
            code="not-a-calibration",
            size_bytes=len(content),
            limit_bytes=_LIMIT_BYTES,
        )
    try:
        plain = strict_yaml.load_plain(content)
    except strict_yaml.StrictYamlError as problem:
        raise CalibrationFileError(
            f"{where}: damaged, or no calibration file: {problem}.", code="damaged-calibration"
        ) from None
    if not isinstance(plain, dict) or plain.get("format") != FORMAT_NAME:
        found = plain.get("format") if isinstance(plain, dict) else None
        raise CalibrationFileError(
            f"{where}: not a calibration file: format is {found!r}, expected {FORMAT_NAME!r}.",
            code="not-a-calibration",
            remedy="Give one that `calibrate solve` wrote.",
        )
    try:
        hash_now = content_sha256(plain)
    except (TypeError, ValueError) as problem:
        raise CalibrationFileError(f"{where}: damaged ({problem}).", code="damaged-calibration") from None
    if plain.pop("sha256", None) != hash_now:
        raise CalibrationFileError(
            f"{where}: the content does not fit its hash: it was edited by hand or damaged.",
            code="damaged-calibration",
            remedy="Use the original, or solve the recording again.",
        )
    return plain


def content_sha256(plain: dict[str, Any]) -> str:
    """Over everything but `sha256` and `created`, independent of layout."""
    content = {key: value for key, value in plain.items() if key not in ("sha256", "created")}
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()


def canonical_json(value: object) -> str:
    """JSON with sorted keys and no spaces, to the byte as `msgspec.json.encode(order="deterministic")`.

    TypeError for what JSON does not know, ValueError for other keys than text.
    """
    if isinstance(value, str):
        return str(encode_basestring(value))
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, list | tuple):
        return f"[{','.join(map(canonical_json, value))}]"
    if isinstance(value, dict):
        if not all(isinstance(key, str) for key in value):
            raise ValueError("a key is no text")
        return f"{{{','.join(f'{canonical_json(k)}:{canonical_json(value[k])}' for k in sorted(value))}}}"
    raise TypeError(f"{type(value).__name__} is no JSON")


def _number(value: float) -> str:
    """The shortest digits that read back as `value`; 1e-5 is written 0.00001, and 1e16 without a +."""
    mantissa, _, exponent = repr(value).partition("e")
    if not exponent:
        return mantissa if np.isfinite(value) else "null"
    if int(exponent) == -5:
        sign = "-" if mantissa.startswith("-") else ""
        return f"{sign}0.0000{mantissa.lstrip('-').replace('.', '')}"
    return f"{mantissa}e{int(exponent)}"


@dataclass(frozen=True)
class InstalledDevice:
    model: str
    serial: str


@dataclass(frozen=True, eq=False)
class InstalledLens:
    """Pixel (0, 0) is the centre of the top left pixel, as in OpenCV."""

    width: int
    height: int
    matrix: Array
    """(3, 3), pixels"""
    distortion: Array
    """(n,), as OpenCV orders them"""
    distortion_model: str

    @property
    def model(self) -> CameraModel:
        """The same as `calibrate` and `recordings` pass it on."""
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
    """The arm's table with the X that belongs to it: their frames chain with each other and nothing else."""

    transform: Transform
    """corrected_flange_from_camera (eye-in-hand) or corrected_base_from_camera (eye-to-hand), metres."""
    table: dict[str, list[float]]
    """a_m, d_m, alpha_rad, theta_rad, beta_rad: see `calibrate.kinematics`."""

    def base_from_flange(self, joints_rad: ArrayLike) -> Transform:
        """Compute corrected_base_from_corrected_flange, metres, of joints (6,), radians."""
        return Transform("corrected_base", "corrected_flange", base_from_flange(self.table, joints_rad))


def refused_table(reason: str) -> CalibrationFileError:
    """Make the error of a calibration that offers no table of the arm."""
    return CalibrationFileError(
        f"This calibration offers no table of the arm ({reason}).",
        code="table-not-offered",
        remedy="Use its result, for the arm as it is, or record poses of station plan --for arm.",
        reason=reason,
    )


@dataclass(frozen=True, eq=False)
class InstalledCalibration:
    """What a program needs of an installed calibration. The whole file: `read_calibration(self.path)`."""

    camera_name: str
    version: int
    path: Path
    """The version's own file, which never changes."""
    validity: Validity
    plain: dict[str, Any]
    """Everything in the file, as it stands there."""

    @cached_property
    def transform(self) -> Transform:
        """flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand), metres; the arm as it is."""
        result = self.plain["result"]
        return Transform(result["parent_frame"], result["child_frame"], np.array(result["matrix"], float))

    @cached_property
    def corrected_arm(self) -> InstalledArm:
        """The arm's corrected table with the X that belongs to it. CalibrationFileError if not offered."""
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
        """(6, 6) of δt (m), δφ (rad), both in the parent frame."""
        return np.array(self.plain["covariance"], float)

    @cached_property
    def intrinsics(self) -> InstalledLens:
        """The lens that belongs to this result."""
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
        """When it was solved, UTC."""
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
    root: Path | None = None,
    allow_simulated: bool = False,
    *,
    camera: str = MAIN_CAMERA,
    require_valid: bool | None = None,
    robot_serial: str = "",
    camera_serial: str = "",
) -> InstalledCalibration:
    """Load the installed calibration of `camera`, proven by its hash: the call for programs that use it.

    `.validity` says whether it still holds. `require_valid`: None refuses what is in doubt or withdrawn, True
    also what is unverified, False nothing. `robot_serial`, `camera_serial`: of the devices that are there;
    another one than the calibration's puts it in doubt, for this call.

    Raises InstallError when nothing is installed (`nothing-installed`), when it is simulated and that was not
    asked for (`not-real`), when its validity is refused (`calibration-in-doubt`, `calibration-unverified`,
    `calibration-withdrawn`); CalibrationFileError when it is damaged.
    """
    found = _read(root, camera)
    if found.source in _NOT_REAL and not allow_simulated:
        raise InstallError(
            f"{found.path}: the installed calibration is {found.source}, not of a real cell.",
            code="not-real",
            source=found.source,
        )
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
                    validity=replace(
                        found.validity, state=doubt, since=time_text(datetime.now(UTC)), reason=reason
                    ),
                )
    _require(found, require_valid)
    return found


def _read(root: Path | None, camera: str) -> InstalledCalibration:
    folder = readable_folder(root, camera)
    number, path = current_version(folder)
    plain = proven_plain(read_bounded(path), str(path))
    try:
        check_result(plain, str(path))
    except (KeyError, TypeError, ValueError) as problem:
        raise CalibrationFileError(
            f"{path}: {problem} is missing or of another kind.", code="contradiction"
        ) from None
    return InstalledCalibration(camera, number, path, _validity_of(folder, number), plain)


def _require(found: InstalledCalibration, valid: bool | None) -> None:
    validity = found.validity
    refused = [ValidityState.IN_DOUBT, ValidityState.WITHDRAWN]
    if valid:
        refused.append(ValidityState.UNVERIFIED)
    if valid is False or validity.state not in refused:
        return
    raise InstallError(
        f"{found.path}: {validity_text(validity).rstrip('.')}.",
        code=f"calibration-{validity.state}",
        remedy="Run `station drift-check`, or calibrate again; require_valid=False loads it all the same.",
        camera=found.camera_name,
        version=found.version,
        since=validity.since,
        reason=validity.reason.code,
    )


def check_result(plain: dict[str, Any], where: str) -> None:
    """Raise CalibrationFileError (code `contradiction`) for a result that no solve can have written."""
    result, mount = plain["result"], plain["mount"]
    matrix, quaternion, translation, covariance = (
        np.array(value, float)
        for value in (
            result["matrix"],
            result["rotation_xyzw"],
            result["translation_m"],
            plain["covariance"],
        )
    )
    parent = "flange" if mount == "eye-in-hand" else "base"
    wrong = ""
    if (result["parent_frame"], result["child_frame"]) != (parent, "camera"):
        wrong = f"{mount} with {result['parent_frame']}_from_{result['child_frame']}"
    elif matrix.shape != (4, 4) or not is_rigid(matrix) or abs(np.linalg.norm(quaternion) - 1) > 1e-6:
        wrong = "the result is not a rigid transform"
    elif (
        np.abs(_rotation(quaternion) - matrix[:3, :3]).max() > 1e-9
        or np.abs(matrix[:3, 3] - translation).max() > 1e-12
    ):
        wrong = "matrix, translation and quaternion do not agree"
    elif covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        wrong = "the covariance is not 6 × 6 finite numbers"
    else:
        rounding = 1e-9 * float(np.abs(covariance).max())
        asymmetry = np.abs(covariance - covariance.T).max()
        if asymmetry > rounding or np.linalg.eigvalsh(covariance).min() < -rounding:
            wrong = "the covariance is not symmetric and positive"
    wrong = wrong or _wrong_table(plain.get("arm_table"), parent)
    if wrong:
        raise CalibrationFileError(
            f"{where}: {wrong}.", code="contradiction", remedy="Solve the recording again."
        )


def _wrong_table(arm: dict[str, Any] | None, parent: str) -> str:
    """Tell what is wrong with an offered table of the arm; empty when nothing is."""
    if arm is None or not (arm["offered"] or arm.get("result") or arm.get("corrected")):
        return ""
    result = arm.get("result") or {}
    frames = (result.get("parent_frame"), result.get("child_frame"))
    if not arm["offered"] or not arm.get("corrected") or frames != (f"corrected_{parent}", "camera"):
        return "the arm's table and its X do not belong together"
    numbers = [np.array(arm["corrected"][key], float) for key in TABLE_COLUMNS]
    if not is_rigid(np.array(result["matrix"], float)) or not all(
        column.shape == (6,) and np.isfinite(column).all() for column in numbers
    ):
        return "the arm's table or its X holds impossible numbers"
    return ""


def _rotation(quaternion_xyzw: Array) -> Array:
    """(3, 3) of a unit quaternion (4,): R = (w² - v·v) I + 2 v vᵀ + 2 w [v]× (Kuipers 1999, eq. 5.11)."""
    v, w = quaternion_xyzw[:3], quaternion_xyzw[3]
    return np.asarray((w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * skew(v))


# --- and when it changes ---
@dataclass(frozen=True, eq=False)
class InstallationChange:
    """What happened to the installed calibration of a camera."""

    event: str
    """installed, rolled-back, valid, unverified, in-doubt, withdrawn, or unreadable"""
    installed: InstalledCalibration | None
    problem: CalibrationError | None = None
    """Why it is unreadable."""


def watch(
    root: Path | None = None,
    *,
    camera: str = MAIN_CAMERA,
    poll_s: float = 1.0,
    stop_s: float | None = None,
    first: bool = False,
) -> Iterator[InstallationChange]:
    """Yield every change of the installed calibration of `camera`: install, rollback, doubt, its end.

    `first`: begin with what is installed now, so that nothing is missed between loading and watching.

    Looks every `poll_s` seconds at two files' times, on any file system; reads only what changed. Also yields
    when the last proof grows too old by the cell's rule. `stop_s`: seconds after which it ends; None: never.
    Nothing real is asked for and nothing refused: look at `.installed.source` and `.installed.validity`.
    """
    folder = calibrations_folder(root, camera)
    ends_s = None if stop_s is None else time.monotonic() + stop_s
    marks = _marks(folder)  # before looking: what changes meanwhile is seen at the next look
    before = _look(root, camera, None)
    if first:
        yield before
    while ends_s is None or time.monotonic() < ends_s:
        time.sleep(poll_s)
        seen = _marks(folder)
        ages = before.installed is not None and _aged(before.installed)
        if seen == marks and not ages:
            continue
        marks, now = seen, _look(root, camera, before)
        if _key(now) != _key(before):
            yield now
        before = now


def _marks(folder: Path) -> list[int]:
    """Times of change of `current` and of the validity; 0 where there is none."""
    marks = []
    for name in ("current", FILE):
        try:
            marks.append((folder / name).lstat().st_mtime_ns)
        except OSError:
            marks.append(0)
    return marks


def _aged(installed: InstalledCalibration) -> bool:
    return installed.validity.at(datetime.now(UTC)).state is not installed.validity.state


def _look(root: Path | None, camera: str, before: InstallationChange | None) -> InstallationChange:
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
