"""Objects that the commands print with `--json`; docs/schemas/ is made from these types."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

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


class DriftCheckJson(msgspec.Struct, frozen=True):
    """`calibrate drift-check --json`: the fields of `DriftCheck`, and what follows for what is installed."""

    passed: bool
    own_views: bool
    shift: NDArray[np.float64]
    covariance: NDArray[np.float64]
    statistic: float
    threshold: float
    p_value: float
    power_translation: float
    power_rotation: float
    views_needed: int | None
    disagreement: float
    views: int
    arm_known: bool
    trend: str
    validity: Validity | None
