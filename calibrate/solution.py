"""What the solver is asked and what it answers: plain values, no files, no gates.

Lengths in metres, angles in radians; every sigma and covariance is of `geometry.perturb`'s delta
[δt, δφ] in the parent frame of X.
"""

# ruff: noqa: N815  (e_t and e_R are written as the paper writes them)
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from calibrate.geometry import Array, Transform
from calibrate.views import ImageView
from recordings.messages import CameraModel, Mount

Profile = Literal["robust", "paper"]
KinematicPrior = Literal["auto", "on", "off"]


@dataclass(frozen=True)
class SolveOptions:
    profile: Profile = "robust"
    seed: int = 0
    intrinsics_from_same_pictures: bool = False
    """The camera model was fitted to these very pictures: the last stage refines it together with X
    (robust profile; plumb_bob only), and its uncertainty is part of X's covariance."""
    reject_outliers: bool = True
    kinematic_prior: KinematicPrior = "auto"
    """Model errors of the arm's Denavit-Hartenberg table. auto: where joints were recorded, unless the
    residuals speak against them."""
    working_distance_m: float | None = None
    """Where the predicted error is stated, along the camera's axis; None = median board distance."""
    holdout: bool = True


@dataclass(frozen=True)
class RejectedView:
    index: int
    """Pose number of the session."""
    name: str
    reason: str
    """One sentence for people."""
    kind: Literal[
        "turned-board",
        "wrong-pose",
        "wrong-square-size",
        "moved-board",
        "wrong-number",
        "inconsistent",
        "corners",
        "unreadable-picture",
        "by-hand",
    ]
    wrong_number: int | None = None
    """Place in [δt, δφ] of the only wrong number of its recorded pose."""


@dataclass(frozen=True, eq=False)
class HoldoutScore:
    """Equations 24 to 26 of the paper on pairs that took no part in the fit."""

    e_t_m: float
    """Mean translation error."""
    e_R: float
    """Mean spectral norm of the rotation error."""
    samples_e_t_m: Array
    """(m,) per held-out pair."""
    samples_e_R: Array
    pairs: tuple[tuple[int, int], ...]
    """Pose numbers (earlier, later) of the held-out pairs."""
    fitted_views: int
    note: str = ""


@dataclass(frozen=True)
class Certificate:
    """Proof that the quadratic objective has no better X: a lower bound from the dual of the SDP relaxation.

    It speaks of `problem` on the inlier pairs, not of the final maximum-likelihood X; `distance_sigma`
    is how far the two are apart.
    """

    certified: bool
    relative_gap: float
    """(objective - lower_bound) / max(objective, floor)"""
    objective: float
    lower_bound: float
    floor: float
    """Absolute floor of the denominator, 1e-8 times the trace of the form."""
    tolerance: float
    unique: bool
    """False where another X reaches the same value (all axes parallel)."""
    distance_sigma: float | None = None
    """Largest number of sigmas, over all directions, between the certified X and the final X."""
    problem: str = ""
    pairs: int = 0
    restarts: int = 0


@dataclass(frozen=True, eq=False)
class Observability:
    weakest_direction: Array
    """(6,) unit [δt, δφ] in X's parent frame, rotation weighed at the working distance."""
    weakest_text: str
    weakest_sigma_m: float
    """1σ along it, as metres at the working distance."""
    largest_angle_rad: float
    """Largest rotation between any two views."""
    axis_spread: float
    """0: all rotations about one axis; 1: axes in all directions alike (second over first singular value)."""


@dataclass(frozen=True)
class ErrorBudget:
    """Share of X's variance by source, summing to 1, and the source that dominates."""

    corners: float
    robot_translation: float
    robot_rotation: float
    intrinsics: float
    kinematics: float

    @property
    def dominant(self) -> str:
        shares = vars(self)
        return max(shares, key=lambda name: float(shares[name])).replace("_", " ")


@dataclass(frozen=True)
class NoiseScales:
    """Standard deviations that the residuals show (restricted maximum likelihood)."""

    corner_px: float
    robot_m: float
    robot_rad: float


@dataclass(frozen=True, eq=False)
class RobotSystematics:
    """Do the robot's residuals follow its joints?"""

    detected: bool
    possible: bool
    """Not to be excluded either."""
    statistic: float
    """Twice the gain of the restricted log-likelihood by the kinematic model; threshold beside it."""
    threshold: float
    worst_joint: str = ""
    worst_joint_rms_m: float = 0.0
    """Flange displacement that errors at this joint explain, rms over the views."""
    prior_applied: bool = False
    """X and its covariance come from the model with kinematic errors."""
    scale_mm: float = 0.0
    """Fitted size of the table's errors, mm or mrad."""
    table_errors: tuple[float, ...] = ()
    """Where applied: estimated a (6), d (6) in metres, alpha (6), theta (6) in radians, true minus nominal.
    Only their sum at the flange is known well, not each one."""
    text: str = ""


@dataclass(frozen=True, eq=False)
class Solution:
    """X and everything that says how good it is."""

    mount: Mount
    profile: Profile
    parent_from_child: Transform
    """flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand)."""
    covariance: Array
    """(6, 6)"""
    confidence_threshold: float
    """δᵀ C⁻¹ δ below this holds the truth in 95 % of cases: 6·F(6, ν), ν ≤ 3N - 6 (see `Estimate`)."""
    board_place: Transform
    """base_from_board or flange_from_board."""
    camera: CameraModel
    """Final intrinsics."""
    rms_px: float | None
    """Corners against the model with the robot's poses adjusted within their noise; None without pixels."""
    used: tuple[int, ...]
    """Pose numbers."""
    rejected: tuple[RejectedView, ...]
    certificate: Certificate
    observability: Observability
    holdout: HoldoutScore | None = None
    kept: tuple[ImageView, ...] = ()
    """The used views as the solver read them, boards turned where that was needed."""
    turned: tuple[int, ...] = ()
    """Views whose corner order was turned by 180° to agree with the others, and kept."""
    in_doubt: dict[int, float] = field(default_factory=dict)
    """Used views that count in part, by pose number: the chance that they are wrong."""
    noise: NoiseScales | None = None
    budget: ErrorBudget | None = None
    systematics: RobotSystematics | None = None
    predicted_error_m: float | None = None
    """1σ (root of the mean squared length) of a point at the working distance on the camera's axis."""
    working_distance_m: float | None = None
    board_spread_m: float | None = None
    """Root mean square distance of the board's origin in base (or flange), view by view, from its mean."""
    board_spread_rad: float | None = None
    residual_px: dict[int, float] = field(default_factory=dict)
    """Pose number → rms of its corners."""
    residual_robot: dict[int, tuple[float, float]] = field(default_factory=dict)
    """Pose number → (metres, radians) between the recorded and the modelled flange."""
    on_box: tuple[str, ...] = ()
    """Paper profile: components of X that lie on the box of equation 22."""
    frames_finding: str = ""
    """The robot's orientations and positions contradict each other (see `frame_check`); "" if they do not."""
    warnings: tuple[str, ...] = ()
    stage_ms: dict[str, float] = field(default_factory=dict)
    solve_ms: float = 0.0
    seed: int = 0

    @property
    def matrix(self) -> Array:
        return self.parent_from_child.matrix

    @property
    def sigma_translation_m(self) -> float:
        """Root mean squared length of the translation's error."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_rotation_rad(self) -> float:
        """Root mean squared angle of the rotation's error."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))


@dataclass(frozen=True, eq=False)
class PeerResult:
    """One row of `calibrate compare`: the same views through another method."""

    name: str
    matrix: Array | None
    """(4, 4); None where the method failed (see `note`)."""
    e_t_m: float | None = None
    e_R: float | None = None
    samples_e_t_m: Array | None = None
    samples_e_R: Array | None = None
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
