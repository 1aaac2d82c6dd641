"""Objects that the commands print with `--json`; docs/schemas/ is made from these types."""

from __future__ import annotations

from typing import Literal

import msgspec

from calibrate.files.calibration import Lens, SessionReading, Sigma
from calibrate.files.validity import Validity
from calibrate.handeye.arm_table import CorrectedArm, FramePose
from calibrate.results import (
    Arm,
    BoardShape,
    Certificate,
    CrossValidation,
    DriftFigures,
    Excluded,
    Gate,
    HoldoutScore,
    MovedPoint,
    PeerResult,
    Remark,
    Views,
)
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
    excluded: Excluded | None
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
    validity: Validity


class InstalledJson(msgspec.Struct, frozen=True):
    """`calibrate install --json`, `calibrate rollback --json`"""

    generation: int
    path: str
    current: str
    validity: Validity


class DriftCheckJson(DriftFigures, frozen=True, kw_only=True, eq=False):
    """`calibrate drift-check --json`: the result, and what follows for what is installed."""

    own_views: bool
    trend: str
    validity: Validity | None
    point: MovedPoint | None
    """How far the shift moves a point; None where the calibration states no distance."""
