"""Objects that the commands print with `--json`; docs/schemas/ is made from these types."""

from __future__ import annotations

from typing import Literal

import msgspec

from calibrate.files.calibration import (
    Arm,
    CorrectedArm,
    FramePose,
    Lens,
    SessionReading,
    Sigma,
    Views,
)
from calibrate.files.validity import Validity
from calibrate.results import BoardShape, Certificate, CrossValidation, Gate, HoldoutScore, PeerResult, Remark
from recordings.schema.messages import Mount


class SolveJson(msgspec.Struct, frozen=True):
    """`calibrate solve --json`"""

    mount: Mount
    result: FramePose
    sigma: Sigma
    covariance: tuple[tuple[float, ...], ...]
    views: Views
    intrinsics: Lens
    holdout: HoldoutScore | None
    certificate: Certificate
    gates: list[Gate]
    verdict: Literal["pass", "fail"]
    warnings: list[Remark]
    cross_validation: CrossValidation | None
    board: BoardShape | None
    session: SessionReading | None
    arm: Arm | None
    arm_table: CorrectedArm | None
    solve_ms: float


class CompareJson(msgspec.Struct, frozen=True):
    """`calibrate compare --json`"""

    mount: Mount
    views: list[int]
    methods: list[PeerResult]


class ListedJson(msgspec.Struct, frozen=True):
    """One of the list that `calibrate list --json` prints."""

    camera: str
    generation: int
    current: bool
    path: str
    problem: str
    session: str | None
    created: str | None
    source: str | None
    sigma: Sigma | None
    validity: Validity | None


class InstalledJson(msgspec.Struct, frozen=True):
    """`calibrate install --json`, `calibrate rollback --json`"""

    generation: int
    path: str
    current: str
    validity: Validity | None


class DriftPowerJson(msgspec.Struct, frozen=True):
    translation_0_5_mm: float
    rotation_0_1_deg: float


class DriftCheckJson(msgspec.Struct, frozen=True):
    """`calibrate drift-check --json`"""

    passed: bool
    own_views: bool
    shift: list[float]
    covariance: list[list[float]]
    statistic: float
    threshold: float
    p_value: float
    power: DriftPowerJson
    views_needed: int | None
    disagreement: float
    views: int
    trend: str
    validity: Validity | None


class WatchEventJson(msgspec.Struct, frozen=True):
    """A line of `calibrate watch --json`; the last one is the summary."""

    event: str
    """learned, not-fixed, testing, alarm, named, pictures-worse, tag-unseen, summary; more may come."""
    picture: str
    pictures: int
    """Pictures with the tag so far."""
    moved: str | None
    """Code of `named`: camera-or-joint-6, tag-base-or-joint-1, joint-2 …, cannot-tell (eye-to-hand:
    camera-base-or-joint-1, tag-gripper-or-joint-6)."""
    values: dict[str, str | float | int | bool | None]
    text: str
    next: list[str]
    """Commands of the shortest way back, in their order."""
    validity: Validity | None
    """Validity of the installed calibration, where the event changed it."""
