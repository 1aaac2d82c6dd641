"""The calibration file, `format: handeye-calibration/2`: its fields, writing, and verified reading.

Field by field in docs/integrator/calibration-file.md. Metres and radians unless the name says
otherwise; covariances are of `geometry.perturb`'s delta.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import yaml
from numpy.typing import ArrayLike

from calibrate.errors import CalibrationFileError
from calibrate.files.integrity import (
    check_result,
    content_sha256,
    read_bounded,
    require_content_of_name,
    verified_plain,
)
from calibrate.files.touch import Touch, agrees
from calibrate.handeye.arm_table import CorrectedArm, FramePose
from calibrate.results import (
    Arm,
    BoardShape,
    Excluded,
    Gate,
    Posterior,
    QualityFigures,
    Remark,
    ViewQuality,
    Views,
)
from recordings import strict_yaml
from recordings.files import ASKED_FOR, MAIN_CAMERA, write_atomically
from recordings.geometry import Transform as Transform
from recordings.plain_text import plain_data
from recordings.schema.messages import (
    BoardSpec,
    CameraIdentity,
    CameraModel,
    Mount,
    RobotIdentity,
    Source,
    WallTime,
)

FORMAT: Literal["handeye-calibration/2"] = "handeye-calibration/2"
MOST_EXCLUDED = 0.2
"""Share of the views that a person may exclude without being asked for a reason."""
Verdict = Literal["PASS", "PASS WITH A REASON", "FAIL"]


class Sigma(msgspec.Struct, frozen=True):
    translation_mm: float
    """Root mean squared length of the translation's error."""
    rotation_deg: float

    @classmethod
    def of(cls, covariance: ArrayLike) -> Sigma:
        """Compute it from a covariance whose first six rows are those of δt (m) and δφ (rad)."""
        shift, turn = np.sqrt(np.diag(np.asarray(covariance))[:6].reshape(2, 3).sum(axis=1)).tolist()
        return cls(1e3 * shift, math.degrees(turn))


class Lens(msgspec.Struct, frozen=True, omit_defaults=True):
    width: int
    height: int
    matrix: tuple[tuple[float, float, float], ...]
    distortion: tuple[float, ...]
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"]
    rms_px: float | None
    found: Literal["from these pictures", "given", "not known"]
    """not known: no pictures, and no matrix."""
    sigma: dict[str, float] = {}

    @property
    def model(self) -> CameraModel:
        return CameraModel(
            self.width, self.height, self.matrix or None, self.distortion, self.distortion_model
        )


class SessionReading(msgspec.Struct, frozen=True, omit_defaults=True):
    """Interpretation that explains the recording best: as recorded, or for instance with inverted poses."""

    hypothesis: str
    text: str
    others: list[str] = []
    """Readings that the evidence does not exclude beside it."""
    changed_from: int | None = None
    """Index of the first view after a change of camera, board or focus."""
    changed_between: tuple[int, int] | None = None
    """Indices of views between which that is, with a probability of 95 %."""


class Quality(QualityFigures, frozen=True, omit_defaults=True, kw_only=True):
    """The figures of a solution, the gates that judge them, and what else speaks for or against it."""

    gates: list[Gate]
    views: list[ViewQuality] = msgspec.field(default_factory=list)
    noise: dict[str, float] = msgspec.field(default_factory=dict)
    """corner_px, robot_mm, robot_deg"""
    weakest: str = ""
    board: BoardShape | None = None
    session: SessionReading | None = None
    arm: Arm | None = None
    warnings: list[str] = msgspec.field(default_factory=list)
    warning_codes: list[str] = msgspec.field(default_factory=list)
    """Code of each of `warnings`."""

    @property
    def remarks(self) -> list[Remark]:
        """The warnings with their codes."""
        return [Remark(code, text) for code, text in zip(self.warning_codes, self.warnings, strict=True)]

    @property
    def without_arm(self) -> bool:
        """Whether the arm's own error is assumed or, in files of before, in the stated one only in part."""
        return any(gate.name == "arm" and gate.remedy for gate in self.gates)

    @property
    def failed(self) -> list[Gate]:
        return [gate for gate in self.gates if not gate.passed]


class Provenance(msgspec.Struct, frozen=True, omit_defaults=True):
    recording: str
    """File name only."""
    recording_sha256: str
    session: str
    software: dict[str, str]
    profile: str
    seed: int
    options: dict[str, Any] = {}
    recorded_wall_ns: WallTime = 0
    plan_sha256: str = ""


class Override(msgspec.Struct, frozen=True):
    """A person's decision to install although something speaks against it; written when installing."""

    reason: str
    who: str
    overridden: list[str]


class Calibration(msgspec.Struct, frozen=True, omit_defaults=True):
    format: Literal["handeye-calibration/2"]
    """Of what is read, too: files of earlier formats become today's (`earlier`)."""
    created: str
    """Time of the solve, UTC; not in the hash. Two runs on one recording differ in nothing else."""
    source: Source
    mount: Mount
    result: FramePose
    sigma: Sigma
    covariance: tuple[tuple[float, ...], ...]
    confidence_threshold: float
    board_place: FramePose
    intrinsics: Lens
    board: BoardSpec
    robot: RobotIdentity
    camera: CameraIdentity
    views: Views
    quality: Quality
    provenance: Provenance
    override: Override | None = None
    verification: list[Touch] = []
    """Touch tests, oldest first; see `touch`."""
    arm_table: CorrectedArm | None = None
    """The arm's corrected kinematics, where they are known; `result` does not depend on them."""
    posterior: Posterior | None = None
    """What later checks begin with; None in files that began in the first format."""
    excluded: Excluded | None = None
    """Views that a person left out; None: none, or in files of before only in `views.rejected`."""

    @property
    def transform(self) -> Transform:
        """flange_from_camera or base_from_camera, for the arm as it is."""
        return self.result.transform

    @property
    def camera_name(self) -> str:
        """Name of the camera in the cell under which it is installed."""
        return self.camera.name or MAIN_CAMERA

    @property
    def verdict(self) -> Verdict:
        """FAIL by a gate; PASS WITH A REASON where a touch missed, a person overrode something else, the
        error is above its limit only by an arm's size that was assumed, or a person excluded more than a
        fifth of the views, or views without which alone it passes."""
        if self.quality.failed:
            return "FAIL"
        assumed = any(gate.name == "predicted_error_m" and gate.over_limit for gate in self.quality.gates)
        reasons = (
            assumed,
            self.override is not None,
            not all(map(agrees, self.verification)),
            self.excluded_too_many,
            self.passes_only_without,
        )
        return "PASS WITH A REASON" if any(reasons) else "PASS"

    @property
    def excluded_views(self) -> list[int]:
        """Pose numbers, from 0, of the views that a person excluded."""
        return [view.index for view in self.views.rejected if view.kind == "by-hand"]

    @property
    def excluded_too_many(self) -> bool:
        """Whether a person excluded more than a fifth of all views."""
        recorded = len(self.views.used) + len(self.views.rejected)
        return len(self.excluded_views) > MOST_EXCLUDED * recorded

    @property
    def passes_only_without(self) -> bool:
        """Whether it passes only without the views that a person excluded."""
        if self.excluded is None or self.quality.failed:
            return False
        all_views = self.excluded.all_views
        return bool(all_views.failed or all_views.problem)


def encode_calibration(calibration: Calibration) -> bytes:
    """YAML text of the file, hash included."""
    # Any text may come from a file name or a device. What the reader refuses is not written.
    harmless = plain_data(msgspec.to_builtins(calibration))
    plain = msgspec.json.decode(msgspec.json.encode(harmless))
    # The hash comes first so that people see it.
    head = {"format": plain.pop("format"), "sha256": "", "created": plain.pop("created")}
    ordered = head | plain
    ordered["sha256"] = content_sha256(ordered)
    text: str = yaml.dump(
        ordered,
        Dumper=strict_yaml.Dumper,
        sort_keys=False,
        default_flow_style=None,
        width=120,
        allow_unicode=True,
    )
    return text.encode()


def decode_calibration(content: bytes, where: str) -> Calibration:
    """Verify and parse a file's bytes; CalibrationFileError says what is wrong."""
    plain = verified_plain(content, where)
    try:
        calibration = msgspec.convert(plain, Calibration)
    except msgspec.ValidationError as problem:
        raise CalibrationFileError(path=where, why=str(problem)) from None
    check_result(plain, where)
    return calibration


def read_calibration(path: Path | str) -> Calibration:
    """Read and verify a calibration file. Raises CalibrationFileError.

    An installed version must also be the one that its name says.
    """
    content = read_bounded(Path(path))
    calibration = decode_calibration(content, str(path))
    require_content_of_name(Path(path), content)
    return calibration


def write_calibration(calibration: Calibration, path: Path | str) -> None:
    """Write the file atomically and durably, and read it before it takes the place of an older one.

    Raises CalibrationFileError; then an older file is still there.
    """
    write_encoded(Path(path), encode_calibration(calibration))


def write_encoded(path: Path, content: bytes) -> None:
    """Write what `encode_calibration` returned; see `write_calibration`."""
    write_output(path, content, lambda written: require_readable(read_bounded(written), str(path)))


def require_readable(content: bytes, where: str) -> None:
    """Read what is to be kept as users will. CalibrationFileError `unreadable-result` where that fails."""
    try:
        decode_calibration(content, where)
    except CalibrationFileError as problem:
        raise CalibrationFileError("unreadable-result", path=where, why=str(problem)) from problem


def write_output(path: Path, content: bytes, check: Callable[[Path], object] | None = None) -> None:
    """Write a file that a user named, atomically and durably. Raises CalibrationFileError.

    `check`: reads the new file before it takes the place of an older one.
    """
    try:
        write_atomically(path, content, ASKED_FOR, check=check)
    except OSError as problem:
        raise CalibrationFileError(
            path=path, why=f"cannot be written: {problem.strerror or problem}"
        ) from None
