"""Results that solver, calibration file and `--json` share; their fields are keys of the file."""
# ruff: noqa: N815  (e_t and e_R are written as the paper writes them)

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrate.arms.chain import LearnedArm


@dataclass(frozen=True)
class Remark:
    """Warning about a solution: a code for programs and a sentence for people."""

    code: str
    text: str


Sense = Literal["≥", "≤"]
UNITS_SHOWN = {
    "m": (1e3, " mm"),
    "deg": (1.0, "°"),
    "s": (1e3, " ms"),
    "px": (1.0, " px"),
    "share": (100.0, " %"),
    "": (1.0, ""),
}
"""Unit of a gate's figure as stored → factor to the unit that people see, and that unit."""
_NARROW = 0.1


class Gate(msgspec.Struct, frozen=True):
    """A condition that a calibration must meet before it may be installed."""

    name: str
    """Id: the name of its limit in `GateLimits`."""
    passed: bool
    value: float | None
    """Value in `unit`; None in a file where it was not a finite number."""
    limit: float | None
    text: str
    """Name, value, unit, limit, PASS, WARN or FAIL, and the remedy of one that did not simply pass."""
    unit: str = ""
    """m, deg, s, px, share; empty for plain numbers."""
    remedy: str = ""
    """Next step; empty when passed, unless with a warning."""
    sense: Sense | None = None
    """Side of the limit on which a value passes; None for a gate without a number."""

    @classmethod
    def measured(
        cls, name: str, title: str, value: float, sense: Sense, limit: float, unit: str, remedy: str
    ) -> Gate:
        """Judge `value` against `limit` and make the gate's text."""
        passed = bool(np.isfinite(value) and (value >= limit if sense == "≥" else value <= limit))
        gate = cls(name, passed, float(value), float(limit), "", unit, "" if passed else remedy, sense)
        limit_unit = UNITS_SHOWN[unit][1] if UNITS_SHOWN[unit][1] in ("°", " %") else ""
        bare = gate.shown(limit).removesuffix(UNITS_SHOWN[unit][1])
        text = f"{title}: {gate.shown(value)} ({sense} {bare}{limit_unit})"
        return msgspec.structs.replace(gate, text=f"{text} PASS" if passed else f"{text} FAIL. {remedy}")

    def as_advice(self, why: str) -> Gate:
        """Make a warning of a closed gate: it passes with its remedy, and says why it does not fail."""
        said = self.text.partition(" FAIL")[0]
        text = f"{said} WARN. {why} {self.remedy}"
        return msgspec.structs.replace(self, passed=True, text=text)

    @property
    def over_limit(self) -> bool:
        """True where the value is on the wrong side of its limit, and a reason lets it pass."""
        if not self.passed or self.value is None or self.limit is None or self.sense is None:
            return False
        return self.value < self.limit if self.sense == "≥" else self.value > self.limit

    def shown(self, figure: float | None) -> str:
        """Format a figure of this gate with the unit for people (mm for m, for instance)."""
        factor, suffix = UNITS_SHOWN.get(self.unit, (1.0, ""))
        return "–" if figure is None else f"{figure * factor:.3g}{suffix}"

    @property
    def title(self) -> str:
        """Name for people."""
        return self.text.partition(":")[0] or self.name

    @property
    def narrow(self) -> bool:
        """True when passed with a warning, or with less than a tenth of the limit to spare."""
        if not self.passed or self.remedy:
            return self.passed
        return bool(self.value is not None and self.limit and abs(self.value / self.limit - 1) <= _NARROW)


class RejectedView(msgspec.Struct, frozen=True, omit_defaults=True):
    index: int
    """Pose number of the session, from 0."""
    name: str
    reason: str
    """For people."""
    kind: str = ""
    """wrong-pose, wrong-number, inconsistent, corners, unreadable-picture, by-hand."""
    belongs_to: int | None = None
    """Pose number of the view whose recorded pose belongs to this image (wrong-pose)."""
    wrong_number: int | None = None
    """Place in [δt, δφ] of the only wrong number of its recorded pose."""
    slip: float = 0.0
    """Recorded minus true of that number, metres or radians."""


class ViewWeight(msgspec.Struct, frozen=True):
    index: int
    weight: float
    """0: rejected; 1: counts fully."""


class Views(msgspec.Struct, frozen=True):
    """What became of the views of a recording, by their pose numbers from 0."""

    used: list[int]
    rejected: list[RejectedView] = []
    turned: list[int] = []
    """Views whose corner order was turned by 180° to agree with the others, and kept."""
    weights: list[ViewWeight] = []


class ViewQuality(msgspec.Struct, frozen=True, omit_defaults=True):
    """How far a used view is from the model."""

    index: int
    rms_px: float | None = None
    """Of its corners, with the board pose that fits them best; None without corners."""
    robot_mm: float | None = None
    """Between the recorded and the modelled flange; None for the paper profile."""
    robot_deg: float | None = None
    """The same of its orientation."""


class AllViews(msgspec.Struct, frozen=True, omit_defaults=True):
    """What the same solve of all views says, where a person excluded some from the result."""

    problem: str = ""
    """Why all views together give no result; empty: they give one."""
    error_mm: float | None = None
    """Its placed-point error, as `predicted_error_mm`."""
    holdout_m: float | None = None
    """Its hold-out's mean translation error, as `HoldoutScore.e_t_m`."""
    failed: list[str] = []
    """Ids of the gates that it fails."""
    shift: tuple[float, ...] = ()
    """(6,) [δt (m), δφ (rad)] of the installed X against that of all views, in X's parent frame."""
    views: list[ViewQuality] = []
    """The excluded views in it; one that it rejected is not here."""
    weights: list[ViewWeight] = []
    """Of the excluded views; 0: it rejected this one, too."""


class Excluded(msgspec.Struct, frozen=True):
    """Views that a person excluded from a solve, and what all views say."""

    views: list[int]
    """Their pose numbers from 0."""
    who: str
    all_views: AllViews


class HoldoutScore(msgspec.Struct, frozen=True, omit_defaults=True):
    """Equations 24 to 26 of the paper on pairs that took no part in the fit."""

    e_t_m: float
    """Mean translation error."""
    e_R: float
    """Mean spectral norm of the rotation error."""
    samples_e_t_m: list[float]
    """Per held-out pair."""
    samples_e_R: list[float]
    pairs: list[tuple[int, int]]
    """Pose numbers (earlier, later) of the held-out pairs."""
    fitted_views: int
    note: str = ""


@dataclass(frozen=True)
class Certificate:
    """Proof that the quadratic objective has no better X: a lower bound from the dual of the SDP relaxation.

    It proves the optimum of `problem` on the inlier pairs, not the final maximum-likelihood X;
    `distance_sigma` tells how far the two are apart.
    """

    certified: bool
    relative_gap: float
    """(objective - lower_bound) / max(objective, floor)"""
    objective: float
    distance_sigma: float | None = None
    """Distance between the certified X and the final X in sigmas, in the direction where it is largest."""
    problem: str = ""
    lower_bound: float = 0.0
    floor: float = 0.0
    """Absolute floor of the denominator, 1e-8 times the trace of the form."""


@dataclass(frozen=True)
class CrossValidation:
    """Errors at the middle of the board of views predicted from the others; only views that count fully."""

    rms_mm: float
    rms_deg: float
    claimed_mm: float
    """Value of `rms_mm` that the stated uncertainties predict: those of a placed point (`PointError`), as far
    as left-out views show them. An error of the arm that all views share is not in it, the noise of the
    boards' poses is."""
    folds: int
    limit: float = 0.0
    """Limit of `rms_mm` over `claimed_mm`; above it the stated uncertainties are too small."""


class PointError(msgspec.Struct, frozen=True, omit_defaults=True):
    """Error of a point as the arm will place it, for the X that is installed and the controller's flanges.

    A picture is taken at one posture, and the tool is sent to the point at another (`handeye.placed_point`).
    Root mean squares of its length, over pairs of postures and all that is uncertain. The three parts add up
    as squares to `error_mm`.
    """

    error_mm: float
    """At the recorded postures."""
    at_m: float
    """Distance of the point from the camera, on its axis."""
    p95_mm: float
    """Distance within which 95 of 100 points are placed."""
    workspace_mm: float
    """As `error_mm`, elsewhere in the workspace: joint 1 anywhere, each other joint in its recorded range and
    half a radian beyond, the flange no farther from the point than at the recorded postures."""
    from_x_mm: float
    """Part of the noise of corners and robot in the views, by X."""
    from_arm_mm: float
    """Part of the arm: its errors at both postures, and what it does differently each time."""
    from_board_lens_mm: float
    """Part of what is uncertain of board and lens."""
    floor_mm: float
    """What would be left of `error_mm` if each view were repeated without end: no calibration lowers it."""
    with_more_views_mm: float
    """What ten more views like these would leave of `error_mm`."""
    arm: Literal["told", "learned", "assumed"]
    """Whence the arm's errors are known: its kinematics or its accuracy were told, they were learned from
    recorded joints, or their size is assumed by its class."""
    arm_class: str = ""
    """The class where they are assumed (`arms.classes`)."""
    corrected_mm: float | None = None
    """`error_mm` by the corrected arm (`arm_table`); None: it is not offered."""


class QualityFigures(msgspec.Struct, frozen=True, omit_defaults=True):
    """Figures that say how good X is: judged by gates, and written to the file as they are."""

    certificate: Certificate
    holdout: HoldoutScore | None = None
    rms_px: float | None = None
    """Rms of the corners against the model, with the robot's poses adjusted within their noise."""
    board_spread_mm: float | None = None
    """Root mean square distance of the board's origin in base (or flange), view by view, from its mean."""
    board_spread_deg: float | None = None
    predicted_error_mm: float | None = None
    """Error of a point at the working distance: `point.error_mm`. In files without `point`: by X alone, where
    the arm's own errors at another posture are left out."""
    working_distance_m: float | None = None
    error_shares: dict[str, float] = {}
    """Source of the error of X → its share of the variance."""
    cross_validation: CrossValidation | None = None
    point: PointError | None = None
    """None in files of before, and for the paper profile."""


class ArmErrorValue(msgspec.Struct, frozen=True):
    """One error of the arm's links or of a bracket, true minus nominal, metres or radians."""

    parameter: str
    value: float
    sigma: float


class Arm(msgspec.Struct, frozen=True):
    """Systematic errors of the robot: of the arm's kinematics, and of a bracket that bends."""

    applied: bool
    """True when the evidence for systematic errors of the arm is clear."""
    log_bayes: float
    """Log evidence for systematic errors of any size against none."""
    size_mm: float
    """1σ of the links' shifts; 0 where only a bracket is modelled."""
    table: list[ArmErrorValue]
    """Only their sum at the flange is known well, not each one."""
    size_mrad: float = 0.0
    """1σ of the links' turns, or of a bracket's bend."""


class BoardShape(msgspec.Struct, frozen=True):
    """Shape of the board by the views, with 1σ each; see `SHAPE`."""

    scale: float
    """True over stated size, minus 1."""
    anisotropy: float
    """x against y of the print."""
    bend_m: tuple[float, float, float]
    sigma: tuple[float, float, float, float, float]

    @property
    def numbers(self) -> NDArray[np.float64]:
        """(5,) in the order of `SHAPE`."""
        return np.array([self.scale, self.anisotropy, *self.bend_m])


class Posterior(msgspec.Struct, frozen=True, omit_defaults=True):
    """What the fit leaves known of camera, lens, board and arm; a later check begins with it.

    Its X belongs to flanges from which `errors` are taken off, so it need not be the installed one.
    """

    X: tuple[tuple[float, ...], ...]
    lens: list[float]
    shape: list[float]
    """As `SHAPE`."""
    errors: list[float]
    """Of the arm's links where `arm` is given, else of its flange (`flange_extent_m`), and of the bracket;
    metres and radians."""
    covariance_lower: list[float]
    """Of [X (δt, δφ), lens, shape, errors]: the lower triangle, row by row."""
    robot_noise: tuple[float, float]
    """1σ per axis of an ordinary view, metres and radians."""
    corner_noise_px: tuple[float, float, float]
    """1σ that moves board poses, that bends lens and shape, and of a single corner."""
    class_shares: list[float]
    """Of ordinary, 3 and 10 times as noisy, and useless views."""
    freedom: float
    """ν of F(6, ν), by which a check has its limit: of the noise, fewer by unknown sizes of errors."""
    board_extent_m: tuple[tuple[float, ...], ...]
    """Middle and half size of the corners seen, to which the bends of `shape` refer."""
    arm: LearnedArm | None = None
    """None: the joints were not recorded, or the arm's errors are not in `errors`."""
    stated_arm_error: tuple[tuple[float, ...], ...] | None = None
    """Covariance (6, 6) of X by the robot's stated error: one in the fit, another in checks elsewhere."""
    level: tuple[float, ...] | None = None
    """Mean direction of gravity in the flange, to which X belongs; None: no bracket's bend in `errors`."""
    flange_extent_m: tuple[float, ...] | None = None
    """Mean place of the flange and its rms distance from there, by which a flange's smooth errors go."""
    without_joints: Posterior | None = None
    """The same for views whose joints are not known, where `arm` is given."""


SHAPE = ("scale", "anisotropy", "bend xx", "bend yy", "bend xy")
"""The board's shape: a point (x, y) of the sheet, (u, v) the same mapped to -1 … 1 over the corners, lies at
(x + s x + a x/2, y + s y - a y/2, b1 (1 - u²) + b2 (1 - v²) + b3 u v); s and a plain, b in metres."""


@dataclass(frozen=True, eq=False)
class PeerResult:
    """One row of `calibrate compare`: the same views through another method."""

    name: str
    matrix: NDArray[np.float64] | None
    """(4, 4); None where the method failed (see `note`)."""
    e_t_m: float | None = None
    e_R: float | None = None
    board_spread_m: float | None = None
    board_spread_rad: float | None = None
    reprojection_px: float | None = None
    """Root mean square with the robot's poses taken as exact and the best board place for this X."""
    distance_sigma: float | None = None
    """Distance from ours, sigmas of ours."""
    time_ms: float = 0.0
    note: str = ""
    on_box: tuple[str, ...] = ()
    """The paper's method: components of X on the box of equation 22. Such an X is wrong."""
    rigid: bool = True
    """False where the method's raw matrix is not a rigid transform."""


class MovedPoint(msgspec.Struct, frozen=True):
    """A point on the camera's axis, as a shift of the camera moves what is measured of it."""

    at_m: float
    """Distance of the point from the camera."""
    moved_mm: float
    sigma_mm: float
    """What `moved_mm` would be (root mean square) if nothing had moved."""
    placed_mm: float | None
    """Error of a placed point as the calibration states it (`PointError.error_mm`); None: it states none."""


class DriftFigures(msgspec.Struct, frozen=True, eq=False):
    """Result of a drift check, as `calibrate drift-check --json` prints it, too."""

    passed: bool
    shift: NDArray[np.float64]
    """(6,) [δt (m), δφ (rad)] in X's parent frame: where the camera is now against where it was installed."""
    covariance: NDArray[np.float64]
    """(6, 6) of `shift` if nothing changed."""
    statistic: float
    threshold: float
    p_value: float
    power_translation: float
    """Probability to detect a shift of 0.5 mm in the direction that is hardest to see."""
    power_rotation: float
    """Probability to detect a turn of 0.1° about the axis that is hardest to see."""
    views_needed: int | None
    """Estimated number of views like these that make both probabilities 95 %; None where over 30."""
    disagreement: float
    """Squared residuals after the best shift, per degree of freedom: about 1 if the noise is unchanged."""
    views: int
    arm_known: bool
    """False: errors of the arm are not told from a shift, so that a failure proves nothing."""
    elsewhere: bool = False
    """The views are outside the range of the calibration's, where the robot's stated error counts."""
