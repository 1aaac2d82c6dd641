"""The calibration file, `format: handeye-calibration/2`: its fields, writing, and verified reading.

Field by field in docs/integrator/calibration-file.md. Metres and radians unless the name says
otherwise; covariances are of `geometry.perturb`'s delta.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import yaml
from numpy.typing import ArrayLike

from calibrate.chain import Chain, chain_of
from calibrate.errors import CalibrationFileError
from calibrate.files.integrity import check_result, content_sha256, read_bounded, verified_plain
from calibrate.files.touch import Touch
from calibrate.geometry import Array, Transform
from calibrate.kinematics import DhTable
from calibrate.results import (
    BoardShape,
    Certificate,
    CrossValidation,
    Gate,
    HoldoutScore,
    LearnedArm,
    Posterior,
    RejectedView,
    Remark,
)
from calibrate.views import array_of
from recordings.files import ASKED_FOR, MAIN_CAMERA, write_atomically
from recordings.schema.messages import (
    BoardSpec,
    CameraIdentity,
    CameraModel,
    Matrix4,
    Mount,
    RobotIdentity,
    Source,
    WallTime,
)

FORMAT: Literal["handeye-calibration/2"] = "handeye-calibration/2"
Vector3 = tuple[float, float, float]
Verdict = Literal["PASS", "PASS WITH A REASON", "FAIL"]


class FramePose(msgspec.Struct, frozen=True):
    """parent_from_child: maps points of `child_frame` (metres) into `parent_frame`."""

    parent_frame: str
    child_frame: str
    translation_m: Vector3
    rotation_xyzw: tuple[float, float, float, float]
    matrix: Matrix4

    @classmethod
    def of(cls, transform: Transform) -> FramePose:
        return cls(
            transform.parent,
            transform.child,
            tuple(transform.translation_m.tolist()),
            tuple(transform.quaternion_xyzw.tolist()),
            tuple(tuple(row) for row in transform.matrix.tolist()),
        )

    @property
    def transform(self) -> Transform:
        return Transform(self.parent_frame, self.child_frame, np.array(self.matrix))


class Sigma(msgspec.Struct, frozen=True):
    translation_mm: float
    """Root mean squared length of the translation's error."""
    rotation_deg: float

    @classmethod
    def of(cls, covariance: ArrayLike) -> Sigma:
        """Compute it from a covariance whose first six rows are those of δt (m) and δφ (rad)."""
        shift, turn = np.sqrt(np.diag(np.asarray(covariance))[:6].reshape(2, 3).sum(axis=1)).tolist()
        return cls(1e3 * shift, math.degrees(turn))


class ViewWeight(msgspec.Struct, frozen=True):
    index: int
    weight: float


class Views(msgspec.Struct, frozen=True):
    used: list[int]
    rejected: list[RejectedView] = []
    turned: list[int] = []
    weights: list[ViewWeight] = []
    """0: rejected; 1 counts fully. Files of earlier versions omit views of weight 1."""


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


class ViewQuality(msgspec.Struct, frozen=True, omit_defaults=True):
    index: int
    rms_px: float | None = None
    robot_mm: float | None = None
    robot_deg: float | None = None


class SessionReading(msgspec.Struct, frozen=True):
    """Interpretation that explains the recording best: as recorded, or for instance with inverted poses."""

    hypothesis: str
    text: str


class ArmErrorValue(msgspec.Struct, frozen=True):
    """One error of the arm's links or of a bracket, true minus nominal, metres or radians."""

    parameter: str
    value: float
    sigma: float


class Arm(msgspec.Struct, frozen=True):
    applied: bool
    """True when the evidence for systematic errors of the arm is clear."""
    log_bayes: float
    size_mm: float
    """1σ of the links' shifts."""
    table: list[ArmErrorValue]
    size_mrad: float = 0.0
    """1σ of the links' turns; 0 in older files, whose `size_mm` is both."""


class HeldOutViews(msgspec.Struct, frozen=True):
    """Rms error of the board's middle in views predicted from views taken elsewhere."""

    without_table_mm: float
    with_table_mm: float
    views: int


class CorrectedArm(msgspec.Struct, frozen=True, omit_defaults=True):
    """X and the arm's corrected kinematics as one result, given only where offered.

    This X is valid with these kinematics only: its frames are `corrected_base` and `corrected_flange`, which
    chain with `base_from_flange` here and with nothing else. The file's own `result` is for the arm as it is.
    The arm is a table, or a chain of axes that was learned from the recorded joints.
    """

    offered: bool
    model: str
    nominal_source: Literal["published", "factory", "learned"]
    covariance: tuple[tuple[float, ...], ...]
    """Of X's [δt, δφ] and of the errors of the arm's links, as in `quality.arm.table`; metres, radians."""
    with_table_mm: float
    """1σ of a point at the working distance with the corrected arm, averaged over the arm's workspace, or
    over `joints_rad`."""
    without_table_mm: float
    """The same for the uncorrected arm with `result` of the file."""
    nominal: DhTable | None = None
    """Table that the recorded flanges follow."""
    learned: LearnedArm | None = None
    """Chain that the recorded flanges follow, where they follow no table."""
    joints_rad: list[tuple[float, float]] = []
    """Least and greatest of each joint in the recording; a learned chain is not asked beyond."""
    held_out: HeldOutViews | None = None
    refused: str = ""
    """Reason why it is not offered: no-evidence, no-joints, not-nominal, not-better; empty: offered."""
    corrected: DhTable | None = None
    corrected_chain: LearnedArm | None = None
    """The corrected arm as a chain, where `learned` is one."""
    result: FramePose | None = None
    """corrected_flange_from_camera (eye-in-hand) or corrected_base_from_camera."""

    def __post_init__(self) -> None:
        frames = ("", "") if self.result is None else (self.result.parent_frame, self.result.child_frame)
        known = frames in (("corrected_flange", "camera"), ("corrected_base", "camera"))
        kinds = [arm is not None for arm in (self.nominal, self.learned)]
        given = [arm is not None for arm in (self.corrected, self.corrected_chain)]
        if not (self.offered == known == (self.result is not None)) or sum(kinds) != 1:
            raise ValueError("the corrected arm and its X do not belong together")
        if given != (kinds if self.offered else [False, False]):
            raise ValueError("the corrected arm is of another kind than the nominal one")

    def base_from_flange(self, joints_rad: ArrayLike) -> Transform:
        """Compute corrected_base_from_corrected_flange of joints (n,).

        Raises as `installable`; CalibrationFileError (`joints-beyond`) where a learned chain was not seen.
        """
        flange = self.chain.forward(self._within(joints_rad)[None])[0]
        return Transform("corrected_base", "corrected_flange", flange)

    def covariance_of_flange(self, joints_rad: ArrayLike) -> Array:
        """Compute the covariance (6, 6) of `base_from_flange`, δt (m) and δφ (rad) in base. Raises as it."""
        J = self.chain.by_links(self._within(joints_rad)[None])[0]
        return np.asarray(J @ np.array(self.covariance)[6:, 6:] @ J.T)

    @property
    def chain(self) -> Chain:
        """The corrected arm. Raises as `installable`."""
        self.installable()
        return _chain(self.corrected, self.corrected_chain)

    @property
    def nominal_chain(self) -> Chain:
        """The arm as its controller computes it."""
        return _chain(self.nominal, self.learned)

    def installable(self) -> tuple[DhTable | None, Transform]:
        """Return the table, if it is one, and the X that belongs to it. CalibrationFileError if refused."""
        if self.result is None:
            raise CalibrationFileError("table-not-offered", reason=self.refused)
        return self.corrected, self.result.transform

    def _within(self, joints_rad: ArrayLike) -> Array:
        q = array_of(joints_rad, self.nominal_chain.posture_rad.shape, "joints_rad")
        for joint, (low, high) in enumerate(self.joints_rad if self.learned else (), start=1):
            if not low <= (at := float(q[joint - 1])) <= high:
                low_deg, at_deg, high_deg = (math.degrees(v) for v in (low, at, high))
                raise CalibrationFileError(
                    "joints-beyond", joint=joint, at_deg=at_deg, low_deg=low_deg, high_deg=high_deg
                )
        return q


def _chain(table: DhTable | None, chain: LearnedArm | None) -> Chain:
    if chain is not None:
        return Chain.of(chain)
    assert table is not None  # one of them: `__post_init__`
    return chain_of(table)


class Quality(msgspec.Struct, frozen=True, omit_defaults=True):
    gates: list[Gate]
    certificate: Certificate
    holdout: HoldoutScore | None = None
    rms_px: float | None = None
    views: list[ViewQuality] = []
    board_spread_mm: float | None = None
    board_spread_deg: float | None = None
    predicted_error_mm: float | None = None
    working_distance_m: float | None = None
    noise: dict[str, float] = {}
    """corner_px, robot_mm, robot_deg"""
    error_shares: dict[str, float] = {}
    weakest: str = ""
    board: BoardShape | None = None
    cross_validation: CrossValidation | None = None
    session: SessionReading | None = None
    arm: Arm | None = None
    warnings: list[str] = []
    warning_codes: list[str] = []
    """Code of each of `warnings`."""

    @property
    def remarks(self) -> list[Remark]:
        """The warnings with their codes."""
        return [Remark(code, text) for code, text in zip(self.warning_codes, self.warnings, strict=True)]

    @property
    def without_arm(self) -> bool:
        """Whether the stated error holds only the smooth part of the arm's own, by the gate `arm`."""
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
    format: Literal["handeye-calibration/1", "handeye-calibration/2"]
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
    """What later checks begin with; None in files of the first version."""

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
        """Verdict of the gates, or of the person who overrode one."""
        if self.override is not None:
            return "PASS WITH A REASON"
        return "FAIL" if self.quality.failed else "PASS"


def encode_calibration(calibration: Calibration) -> bytes:
    """YAML text of the file, hash included."""
    plain = msgspec.json.decode(msgspec.json.encode(calibration))
    # The hash comes first so that people see it.
    head = {"format": plain.pop("format"), "sha256": "", "created": plain.pop("created")}
    ordered = head | plain
    ordered["sha256"] = content_sha256(ordered)
    text: str = yaml.dump(
        ordered,
        Dumper=yaml.CSafeDumper,
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
    """Read and verify a calibration file. Raises CalibrationFileError."""
    return decode_calibration(read_bounded(Path(path)), str(path))


def write_calibration(calibration: Calibration, path: Path | str) -> None:
    """Write the file atomically and durably. Raises CalibrationFileError."""
    write_output(Path(path), encode_calibration(calibration))


def write_output(path: Path, content: bytes) -> None:
    """Write a file that a user named, atomically and durably. Raises CalibrationFileError."""
    try:
        write_atomically(path, content, ASKED_FOR)
    except OSError as problem:
        raise CalibrationFileError(
            path=path, why=f"cannot be written: {problem.strerror or problem}"
        ) from None
