"""From views to the estimate: a global start, corner orders corrected, then all unknowns together."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from calibrate.arms.classes import ARM_CLASSES, UNKNOWN, ArmClass
from calibrate.errors import BadViewsError, PosesDisagreeError
from calibrate.handeye.arm import ArmPostures, arm_postures, flange_extent, flex_motion, smooth_motion
from calibrate.handeye.arm_fit import estimate_with_arm_errors
from calibrate.handeye.assumed_arm import TOLD, assumed_postures, link_sizes
from calibrate.handeye.axxb.global_start import GlobalResult, solve_global
from calibrate.handeye.axxb.pairs import Pairs, all_pairs, mount_poses
from calibrate.handeye.cell_state import CellState
from calibrate.handeye.estimate import Estimate, estimate
from calibrate.handeye.metrics import require_motion
from calibrate.handeye.pose_fit import BoardPoses, agreed_start, pose_distances
from calibrate.handeye.priors import Priors
from calibrate.results import SHAPE
from calibrate.views.view_set import BoardView, Observations, Places, ViewSet, observe_views
from recordings.geometry import Array, difference, inverse, pose, rotation_exp, transform_points

STAGES = logging.getLogger("calibrate.stages")
"""Tells people who wait what is computed: with number of the stage, of how many, and what is done in it."""
FEWEST_FOR_ARM_ERRORS = 8
"""Fewest views from which errors of the arm can be told from noise."""
FEWEST_USED = 3
"""Fewest views that must not be rejected: two motions need three views."""
_NARROW = 0.5
"""Robot noise of the narrow start, as a multiple of what the residuals' medians say (wide: `WIDE`)."""
_CLEARLY = 5.0
"""Log evidence by which the estimate from the narrow start must beat the one from the wide start."""
MAX_ROBOT_M, MAX_ROBOT_RAD = 0.03, float(np.radians(3.0))
"""Above this robot noise (1σ per axis, metres and radians) the poses are refused."""


@dataclass(frozen=True, eq=False)
class AssumedArm:
    """The fit of an arm that stands in for one whose joints and kinematics nobody told."""

    arm: ArmPostures
    """A typical arm, with its joints in the views at `places`."""
    places: Places
    observed: Observations
    estimate: Estimate


@dataclass(frozen=True, eq=False)
class CellFit:
    """Result of `fit_cell`: the estimate and what is needed to judge it."""

    views: ViewSet
    """The input, with boards rotated onto themselves where their corner order disagreed."""
    turned: tuple[int, ...]
    """Indices of the views whose board was rotated."""
    observed: Observations
    priors: Priors
    estimate: Estimate
    log_bayes: float | None
    """Log evidence of systematic errors of arm and bracket; None where they were not modelled."""
    arm: ArmPostures | None
    """None where errors of the arm's links are not among them."""
    plain: Estimate
    """The estimate without systematic errors of arm and bracket."""
    smooth: Estimate | None
    """The estimate for flanges that err smoothly, whatever the joints say; None where not modelled."""
    assumed: AssumedArm | None
    """The estimate for a typical arm; None where `arm` is known, or no typical arm reaches the views."""
    pairs: Pairs
    """Pairs of the views that count."""
    certified: GlobalResult
    """Optimum of the quadratic objective over these pairs."""
    arm_failure: str = ""
    """Why systematic errors could not be fitted, where that failed."""
    joints_note: str = ""
    """What is unusual about the recorded joints."""
    of_class: ArmClass = ARM_CLASSES[UNKNOWN]
    """How far such an arm is off, where neither its joints nor its kinematics are told."""

    @property
    def accuracy_told(self) -> bool:
        """Whether `of_class` holds figures that were told of this very arm."""
        return self.of_class.name == TOLD

    @property
    def unknown_arm(self) -> Array:
        """Compute what errors of an arm of unknown kinematics add to the covariance (6, 6) of X.

        X stays where it fits the flanges as they are told. Its distance from the mean with such errors is
        error.
        """
        fitted = self.smooth if self.assumed is None else self.assumed.estimate
        if self.arm is not None or fitted is None:
            return np.zeros((6, 6))
        found = self.estimate
        off = difference(fitted.state.X, found.state.X)
        added = fitted.covariance[:6, :6] + np.outer(off, off) - found.covariance[:6, :6]
        values, vectors = np.linalg.eigh((added + added.T) / 2)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def fit_cell(views: ViewSet, priors: Priors, seed: int, of_class: ArmClass = ARM_CLASSES[UNKNOWN]) -> CellFit:
    """Estimate all unknowns of a cell from views with their board poses.

    of_class: how far an arm may be off of which neither joints nor kinematics are told.

    Errors of arm and bracket are among them from `FEWEST_FOR_ARM_ERRORS` views on. Raises BadViewsError or
    DegenerateMotionError where X is not determined, PosesDisagreeError where the noise is beyond its limits.
    """
    H, C = mount_poses(views.base_from_flange, views.mount), views.camera_from_board
    pairs = all_pairs(H, C)
    require_motion(pairs)
    STAGES.info("%d of %d: %s", 1, 4, "the best start, from all pairs of views")
    certified = solve_global(pairs)
    start = agreed_start(H, BoardPoses.known(C), seed, certified.X)
    views, turned = set_boards_right(views, start.X, start.Y)
    observed, C = observe_views(views), views.camera_from_board
    state = CellState(start.X, start.Y, C, views.camera, np.zeros(len(SHAPE)), np.zeros(0))
    STAGES.info("%d of %d: %s", 2, 4, "camera, board and lens together")
    found = _likeliest(observed, state, priors)
    require_plausible_noise(found)
    plain, log_bayes, smooth, failure = found, None, None, ""
    arm, joints_note = arm_postures(views, plain.used)
    if plain.used.sum() >= FEWEST_FOR_ARM_ERRORS:
        flex = flex_motion(views.base_from_flange)
        links = flex[..., :0] if arm is None else arm.chain.by_links(arm.joints_rad)
        # A pose that is told metres away must neither set the range nor be explained by these errors.
        extent = flange_extent(observed.flange[plain.used])
        smoothly = smooth_motion(observed.flange, extent) * plain.used[:, None, None]
        STAGES.info("%d of %d: %s", 3, 4, "errors of the arm")

        def with_errors(by_arm: Array) -> tuple[Observations, Estimate, float | None]:
            seen = replace(observed, by_arm_errors=np.concatenate([by_arm, flex], axis=2))
            fitted, evidence = estimate_with_arm_errors(seen, plain, priors)
            if fitted.used.sum() < FEWEST_USED:
                raise np.linalg.LinAlgError("with them nearly every view is rejected")
            return seen, fitted, evidence

        try:
            _, smooth, _ = with_errors(smoothly)
        except (BadViewsError, np.linalg.LinAlgError) as problem:
            failure = str(problem)
        try:
            observed, found, log_bayes = with_errors(links)
        except (BadViewsError, np.linalg.LinAlgError) as problem:
            failure = str(problem)
    assumed = None
    if log_bayes is None or arm is None:
        try:
            assumed = _assume_arm(views, observed, plain, priors, of_class)
        except (BadViewsError, np.linalg.LinAlgError) as problem:
            failure = str(problem)
    pairs, certified = _certify(views, found, np.flatnonzero(found.used))
    require_motion(pairs)  # a wrong view may have been the only one about a second axis
    arm = None if log_bayes is None else arm
    return CellFit(
        views, turned, observed, priors, found, log_bayes, arm, plain, smooth, assumed, pairs, certified,
        failure, joints_note, of_class,
    )  # fmt: skip


def _assume_arm(
    views: ViewSet, observed: Observations, plain: Estimate, priors: Priors, of_class: ArmClass
) -> AssumedArm | None:
    """Fit the errors of a typical arm of this class; None where none reaches the used views."""
    places = np.flatnonzero(plain.used)
    arm = assumed_postures(views.base_from_flange[places])
    if arm is None:
        return None
    by_links = arm.chain.by_links(arm.joints_rad)
    by_arm = np.zeros((len(views), *by_links.shape[1:]))
    by_arm[places] = by_links
    flex = flex_motion(views.base_from_flange)
    seen = replace(observed, by_arm_errors=np.concatenate([by_arm, flex], axis=2))
    found, _ = estimate_with_arm_errors(seen, plain, priors, link_sizes(arm, of_class))
    return AssumedArm(arm, places, seen, found)


def _likeliest(observed: Observations, start: CellState, priors: Priors) -> Estimate:
    """Estimate from a wide and a narrow initial robot noise; take the narrow one only if clearly likelier.

    A narrow start rejects more views at once.
    """
    found = estimate(observed, start, priors)
    narrow = estimate(observed, start, priors, wide=_NARROW)
    return narrow if narrow.log_evidence > found.log_evidence + _CLEARLY else found


def _certify(views: ViewSet, found: Estimate, places: Places) -> tuple[Pairs, GlobalResult]:
    """Solve A X = X B over the used views again, with the board poses of the final lens and board."""
    H = mount_poses(views.base_from_flange, views.mount)[places]
    pairs = all_pairs(H, found.board_poses[places])
    return pairs, solve_global(pairs, f"the quadratic objective over the pairs of {len(places)} used views")


def require_plausible_noise(found: Estimate) -> None:
    """Raise PosesDisagreeError where the robot noise is above its limit, or nearly every view is rejected."""
    robot_m, robot_rad = found.scales.robot
    if found.used.sum() < FEWEST_USED:
        raise PosesDisagreeError(how="in nearly every view", advice=_MEND)
    if robot_m > MAX_ROBOT_M or robot_rad > MAX_ROBOT_RAD:
        raise PosesDisagreeError(
            how=f"by {robot_m * 1e3:.0f} mm, {np.degrees(robot_rad):.1f}° per axis", advice=_MEND
        )


_MEND = "Check the mounting, units and order of poses, and that each belongs to its image."
_NEARER = 0.2
"""A rotated board is accepted when its distance to the board's pose falls below this share of before."""


def set_boards_right(views: ViewSet, X: Array, Y: Array) -> tuple[ViewSet, tuple[int, ...]]:
    """Rotate a board onto itself where that brings it to Y (4, 4): its corners were counted from another end.

    Returns the views, and the places of those changed.
    """
    H = mount_poses(views.base_from_flange, views.mount)
    apart = pose_distances(H @ X @ views.camera_from_board, Y[None])
    kept, turned = list(views.views), []
    for place, view in enumerate(views):
        for turn in _turns(view):
            trial = _turned(view, turn)
            placed = H[place] @ X @ trial.camera_from_board
            if pose_distances(placed[None], Y[None]) < _NEARER * apart[place]:
                kept[place] = trial
                turned.append(place)
                break
    return (replace(views, views=tuple(kept)) if turned else views), tuple(turned)


def _turns(view: BoardView) -> list[Array]:
    """List the rotations of the board onto itself: by 180°, and by ±90° where it is square."""
    if not len(view.corners.points):
        return []
    low, high = view.corners.points.min(axis=0), view.corners.points.max(axis=0)
    centre = (low + high) / 2
    square = abs((high - low)[0] - (high - low)[1]) < 1e-9
    turns = []
    for quarter in (2, 1, 3) if square else (2,):
        R = rotation_exp([0.0, 0.0, quarter * np.pi / 2])
        turns.append(pose(R, centre - R @ centre))
    return turns


def _turned(view: BoardView, turn: Array) -> BoardView:
    return replace(
        view,
        corners=replace(view.corners, points=transform_points(turn, view.corners.points)),
        camera_from_board=np.asarray(view.camera_from_board) @ inverse(turn),
    )
