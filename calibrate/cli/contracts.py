"""Shapes of what the commands print with `--json`; docs/schemas/ is made from them."""

from __future__ import annotations

from typing import TypedDict

from calibrate.files.calibration import Arm, Folds, FramePose, Gate, SessionReading, Sigma
from calibrate.files.hooks import HookRun
from calibrate.files.validity import Validity
from calibrate.results import BoardShape
from recordings.schema.messages import Mount


class RejectedJson(TypedDict):
    index: int
    reason: str
    kind: str


class WeightJson(TypedDict):
    index: int
    weight: float


class ViewsJson(TypedDict):
    used: list[int]
    rejected: list[RejectedJson]
    weights: list[WeightJson]


class LensJson(TypedDict):
    width: int
    height: int
    matrix: list[list[float]]
    distortion: list[float]
    rms_px: float | None


class HoldoutJson(TypedDict):
    e_t_m: float
    e_R: float


class CertificateJson(TypedDict):
    certified: bool
    relative_gap: float
    objective: float
    distance_sigma: float | None


class WarningJson(TypedDict):
    code: str
    text: str


class SolveJson(TypedDict):
    """`calibrate solve --json`"""

    mount: Mount
    result: FramePose
    sigma: Sigma
    covariance: list[list[float]]
    views: ViewsJson
    intrinsics: LensJson
    holdout: HoldoutJson | None
    certificate: CertificateJson
    gates: list[Gate]
    verdict: str
    warnings: list[WarningJson]
    cross_validation: Folds | None
    board: BoardShape | None
    session: SessionReading | None
    arm: Arm | None
    solve_ms: float


class ListedJson(TypedDict):
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


class InstalledJson(TypedDict):
    """`calibrate install --json`, `calibrate rollback --json`"""

    generation: int
    path: str
    current: str
    validity: Validity | None
    hooks: tuple[HookRun, ...]


class DiffJson(TypedDict):
    """`calibrate diff --json`"""

    translation_mm: float
    rotation_deg: float
    sigmas: float
    lens_matrix_px: float | None


class DriftPowerJson(TypedDict):
    translation_0_5_mm: float
    rotation_0_1_deg: float


class DriftCheckJson(TypedDict):
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


class DoubtedJson(TypedDict):
    """One camera that needs a look."""

    cell: str
    camera: str
    state: str
    since: str
    reason: str
    drifting: bool


class FleetJson(TypedDict):
    """`calibrate fleet --json`"""

    cameras: int
    states: dict[str, int]
    doubted: list[DoubtedJson]
