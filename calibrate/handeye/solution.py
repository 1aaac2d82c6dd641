"""Options and results of the solver: plain values, no files, no gates.

Lengths in metres, angles in radians; every sigma and covariance is of `geometry.perturb`'s delta
[δt, δφ] in the parent frame of X.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, get_args

import numpy as np

from calibrate.arms.classes import ARM_CLASSES
from calibrate.errors import require_choice, require_positive
from calibrate.handeye.arm_table import CorrectedArm
from calibrate.handeye.metrics import Observability
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.priors import BoardTolerance
from calibrate.results import (
    Arm,
    BoardShape,
    Posterior,
    QualityFigures,
    Remark,
    ViewQuality,
    Views,
)
from calibrate.views.view_set import BoardView
from recordings.geometry import Array, Transform
from recordings.schema.messages import CameraModel, Mount


def camera_frames(mount: Mount) -> tuple[str, str]:
    """Return (parent, child) of X."""
    return ("flange", "camera") if mount == "eye-in-hand" else ("base", "camera")


def board_frames(mount: Mount) -> tuple[str, str]:
    """Return (parent, child) of the board's constant pose Y."""
    return ("base", "board") if mount == "eye-in-hand" else ("flange", "board")


Profile = Literal["robust", "paper"]


@dataclass(frozen=True)
class SolveOptions:
    """Choices of one solve."""

    profile: Profile = "robust"
    seed: int = 0
    intrinsics_from_same_pictures: bool = False
    """The camera model was fitted to these same images, so it is no prior knowledge of the lens."""
    lens_sigma: tuple[float, ...] | None = None
    """1σ of a given lens in the order of `projection.intrinsics_names`; None: the default 0.2 %."""
    board: BoardTolerance = field(default_factory=BoardTolerance)
    unmirrored: bool = False
    """The board was found by its markers, which are not found in a mirrored image."""
    working_distance_m: float | None = None
    """Distance along the camera's axis for the predicted error; None: median board distance."""
    holdout: bool = True
    folds: bool = True
    """Cross-validate."""
    robot_accuracy_m: float | None = None
    """1σ per axis of an error of the flange that all views share; counts where the arm is not modelled."""
    robot_accuracy_rad: float | None = None
    """The same of its orientation; None: 1 mrad for each mm."""
    arm_class: str = ""
    """Class of the arm (`arms.classes`) as it was told; empty: it is looked up by model and joints."""

    def __post_init__(self) -> None:
        require_choice("profile", self.profile, get_args(Profile))
        if self.arm_class:
            require_choice("arm_class", self.arm_class, ARM_CLASSES)
        require_positive(
            working_distance_m=self.working_distance_m,
            robot_accuracy_m=self.robot_accuracy_m or None,
            robot_accuracy_rad=self.robot_accuracy_rad or None,
        )
        for sigma in self.lens_sigma or ():
            require_positive(lens_sigma=sigma)


_EXPLAINED = 4.0
"""Sigmas of its own tolerance by which a stated value may differ from the views."""


@dataclass(frozen=True, eq=False)
class Finding:
    """Comparison of a stated value (the lens, the board) with the views."""

    sigmas: float
    """Significance of the contradiction, as sigmas of one normal variable."""
    pull_m: float
    """Shift of X at the working distance caused by using the stated value, metres."""
    error_m: float
    """1σ of X at the working distance, without errors of an unknown arm: wrong statements look like them."""

    @property
    def unexplained_m(self) -> float:
        """The part of `pull_m` that the stated value's tolerance does not explain."""
        return float(self.pull_m * np.maximum(0.0, 1.0 - _EXPLAINED / np.maximum(self.sigmas, 1e-9)))


@dataclass(frozen=True, eq=False)
class UncorrectedArm:
    """The X for an arm that stays as it is, with its errors: what its controller's flanges need."""

    X: Array
    """(4, 4) by which points are placed best, where the views are and elsewhere in the workspace."""
    covariance: Array
    """(6, 6)"""


@dataclass(frozen=True)
class ArmErrors:
    """Systematic errors of the robot, and what they mean for X."""

    stated: Arm
    """The errors, and how clear they are."""
    uncorrected: UncorrectedArm | None = None
    """None where the arm's kinematics are not known: only the bracket is modelled."""
    result: CorrectedArm | None = None
    """None as `uncorrected`."""

    @property
    def installed(self) -> UncorrectedArm | None:
        """The X to install beside the controller's flanges; None where the fit's own X serves."""
        return self.uncorrected if self.stated.applied else None


class Reading(Enum):
    """Interpretations of a recording, such as inverted poses; the value is the code in files."""

    AS_RECORDED = "as-recorded"
    INVERSE_POSES = "inverse-poses"
    QUATERNION_ORDER = "quaternion-order"
    ROTATION_VECTOR_AS_ANGLES = "rotation-vector-as-angles"
    ANGLES_AS_ROTATION_VECTOR = "angles-as-rotation-vector"
    INVERSE_ROTATIONS = "inverse-rotations"
    EULER_ORDER = "euler-order"
    SHIFTED = "shifted-pictures"
    MIRRORED = "mirrored-pictures"
    LEFT_HANDED = "left-handed-poses"
    OTHER_BASE = "positions-in-another-base"
    POSITIONS_DISAGREE = "positions-disagree"
    SQUARE_SIZE = "square-size"
    MILLIMETRES = "millimetres"
    FOCAL_LENGTH = "focal-length"
    OTHER_RESOLUTION = "other-resolution"
    BOARD_MOVED = "board-moved"
    CAMERA_MOVED = "camera-moved"
    REFOCUSED = "refocused"


@dataclass(frozen=True)
class Rival:
    """A reading that another one was held against."""

    reading: Reading
    log_evidence_gain: float
    """Gain over the recording as it stands."""
    excluded: bool
    """The reading that is named has so much more evidence that this one is not the cause."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """The reading that explains a recording best, and by how much; with all that it was held against."""

    reading: Reading
    log_evidence_gain: float
    """Gain over the recording as it stands."""
    rivals: tuple[Rival, ...] = ()
    """One of each reading, those with the most evidence first. What is not excluded is named, too.

    A reading by which the board moves further than as recorded was not fitted and is none of them."""
    at: int = 0
    """Index of the first view after a change; for shifted images, by how many poses."""
    between: tuple[int, int] = (0, 0)
    """Indices between which the first view after a change is, with a probability of 95 %."""
    factor: float = 1.0
    """True over configured size of the squares, or focal length, of the later part where it changed."""
    order: tuple[str, str] = ("", "")
    """Orders of angles, as scipy writes them: by which they were read, by which they should have been."""
    numbers: tuple[int, int, int] | None = None
    """Pose numbers of `at` and `between`, from 0; None where nothing changed between two views."""
    size_px: tuple[int, int] = (0, 0)
    """Width and height of the images that the told lens belongs to, where it is not these."""

    @property
    def readings(self) -> tuple[Reading, ...]:
        """The reading, and those that the evidence does not exclude beside it."""
        return (self.reading, *(rival.reading for rival in self.rivals if not rival.excluded))


@dataclass(frozen=True, eq=False)
class FittedCell:
    """What the fit found: camera, lens, board and arm, with what is uncertain about them."""

    mount: Mount
    parent_from_child: Transform
    """X: flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand)."""
    covariance: Array
    """(6, 6) of X."""
    confidence_threshold: float
    """Limit of δᵀ C⁻¹ δ that holds the true X in 95 % of cases: 6·F(6, ν), ν = 3N - 6."""
    board_place: Transform
    """base_from_board or flange_from_board."""
    camera: CameraModel
    """The lens as the fit left it."""
    lens_covariance: Array | None = None
    """(p, p) of `projection.intrinsics_names`; None without corners, and for the paper profile."""
    lens_estimated: bool = False
    """The lens was found from these same images."""
    board: BoardShape | None = None
    """None without corners, and for the paper profile."""
    arm: ArmErrors | None = None
    """None where no errors of arm and bracket were modelled."""
    noise: MeasurementNoise | None = None
    """By restricted maximum likelihood; of corners only the smooth part, which moves the board's pose."""
    posterior: Posterior | None = None
    """What later checks begin with; None for the paper profile and without corners."""

    @property
    def X(self) -> Array:
        """X (4, 4) of the fit: of the corrected arm where errors of the arm are detected."""
        return self.parent_from_child.matrix

    @property
    def installed(self) -> tuple[Array, Array]:
        """X (4, 4) and its covariance (6, 6) for use beside the controller's flanges.

        Where errors of the arm are detected, the fit's own X is worse there than one that knows nothing of
        them.
        """
        as_it_is = None if self.arm is None else self.arm.installed
        return (self.X, self.covariance) if as_it_is is None else (as_it_is.X, as_it_is.covariance)


@dataclass(frozen=True, eq=False)
class Judgement:
    """How good the fit is, and what speaks against it."""

    figures: QualityFigures
    observability: Observability
    coverage: float
    """Share of the image inside the outlines of the boards in the used views; 0 without corners."""
    session: Explanation = field(default_factory=lambda: Explanation(Reading.AS_RECORDED, 0.0))
    """Reading of the recording as a whole."""
    lens_finding: Finding | None = None
    """None where no lens was given."""
    board_finding: Finding | None = None
    on_box: tuple[str, ...] = ()
    """Paper profile: components of X that lie on the box of equation 22."""
    warnings: tuple[Remark, ...] = ()


@dataclass(frozen=True, eq=False)
class Evidence:
    """The views that X rests on, and how well each agrees with it."""

    views: Views
    kept: tuple[BoardView, ...]
    """The used views as the solver read them, boards turned where that was needed."""
    suspects: dict[int, float] = field(default_factory=dict)
    """Pose number of a down-weighted view → probability that it is an outlier."""
    residuals: tuple[ViewQuality, ...] = ()
    """One of each used view, in their order."""

    @property
    def rms_px(self) -> dict[int, float]:
        """Pose number → rms of its corners, px; empty without corners."""
        return {one.index: one.rms_px for one in self.residuals if one.rms_px is not None}

    @property
    def weights(self) -> dict[int, float]:
        """Pose number → weight of the view, 0 (rejected) … 1; empty for the paper profile."""
        return {view.index: view.weight for view in self.views.weights}


@dataclass(frozen=True, eq=False)
class Solution:
    """The answer of the solver in three parts, and how it was asked."""

    fit: FittedCell
    judgement: Judgement
    evidence: Evidence
    profile: Profile
    seed: int = 0

    @property
    def matrix(self) -> Array:
        """X (4, 4) of the fit; see `FittedCell.installed` for the X beside the controller's own flanges."""
        return self.fit.X

    @property
    def covariance(self) -> Array:
        """(6, 6) of `matrix`."""
        return self.fit.covariance

    @property
    def sigma_translation_m(self) -> float:
        """Root mean squared length of the translation's error."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_rotation_rad(self) -> float:
        """Root mean squared angle of the rotation's error."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))
