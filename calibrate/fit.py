"""The robust profile's fit: consensus, maximum likelihood, and verdicts until neither changes the other."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calibrate.board_poses import BoardPoses, refine_board_poses
from calibrate.consensus import Consensus, find_consensus, pose_arrays
from calibrate.errors import PosesDisagreeError
from calibrate.estimate import Estimate, estimate, first_state
from calibrate.likelihood.kinematics import UNIT, kinematic_derivatives
from calibrate.likelihood.model import Observations, observe_views
from calibrate.mixture import find_good_views
from calibrate.outliers import Judgement, explain, judge_views
from calibrate.pairs import Pairs, Places, all_pairs
from calibrate.robust import GlobalResult, solve_global
from calibrate.solution import KinematicPrior, RejectedView, RobotSystematics
from calibrate.stopwatch import Stopwatch
from calibrate.systematics import FEWEST_VIEWS, fit_kinematics
from calibrate.views import ViewSet
from calibrate.worth import number_worths, widen

_ROUNDS = 5
_FEWEST = 4
_FEW = 0.1
"""A smaller share of bad views does not widen the scales enough to hide in them."""
MAX_ROBOT_M = 0.03
MAX_ROBOT_RAD = np.radians(3.0)
"""Beyond this per axis it is not noise: no X is returned."""


@dataclass(frozen=True, eq=False)
class Fit:
    consensus: Consensus
    views: ViewSet
    """All views, turned boards set right."""
    settled: Settled
    rejected: tuple[RejectedView, ...]
    pairs: Pairs
    """All pairs of the kept views, board poses by the final lens."""
    certified: GlobalResult
    """Global optimum over those pairs."""
    systematics: RobotSystematics | None


@dataclass(frozen=True, eq=False)
class Settled:
    """An estimate and the views that it accepts."""

    everything: Observations
    """Of all views."""
    places: Places
    """Those that count as good."""
    fitted: Places
    """Those that the estimate rests on: the good ones, and what is of worth in the others."""
    estimate: Estimate
    verdict: Judgement
    """On all views, by the good ones."""
    boards: BoardPoses
    """Of all views, by their own corners and the final lens."""
    doubts: dict[int, float] = field(default_factory=dict)
    """By place, the good ones that count in part: how likely they are bad."""

    @property
    def observed(self) -> Observations:
        """Of the fitted views."""
        return self.everything.part(self.fitted)


def fit_views(
    views: ViewSet,
    seed: int,
    intrinsics_free: bool,
    reject: bool,
    watch: Stopwatch,
    kinematic_prior: KinematicPrior = "off",
) -> Fit:
    """Raises BadViewsError or DegenerateMotionError as its stages do."""
    consensus = find_consensus(views, seed, reject)
    watch.lap("certified optimum")
    views, places = consensus.views, consensus.places
    everything = observe_views(views)
    H, C = pose_arrays(views)
    start = first_state(everything.part(places), consensus.start.X, C[places], H[places], views.camera)
    plain = estimate(everything.part(places), start, intrinsics_free)
    boards = refine_board_poses(everything, replace(plain.state, C=C))
    group = Settled(everything, places, places, plain, judge_views(everything, plain, boards, places), boards)
    settled = _settle(group, reject)
    _require_plausible_noise(settled.estimate)
    watch.lap("maximum likelihood")
    finding, settled = _with_kinematics(views, group, settled, kinematic_prior, reject)
    watch.lap("robot systematics")
    before = settled
    settled = _with_worths(before) if reject else before
    places = settled.places
    bad = np.setdiff1d(np.arange(len(views)), places)
    rejected = explain(views, replace(before.estimate.state, C=before.boards.C), before.verdict, bad)
    pairs = all_pairs(H[places], settled.boards.C[places])
    problem = f"chordal objective over all {len(pairs)} pairs of the {len(places)} used views"
    certified = solve_global(pairs, seed, problem)
    watch.lap("certified optimum")
    return Fit(consensus, views, settled, rejected, pairs, certified, finding)


def _settle(group: Settled, reject: bool) -> Settled:
    """Those that the mixture finds good judge each other; where it finds no bad ones, the group judges all.

    Many bad views widen the scales until each of them seems likely, and so does every one let in again: where
    the mixture left some out, or the limit more than a few, views only have to leave.
    """
    if not reject:
        return group
    count = len(group.everything.flange)
    good = find_good_views(group.verdict.linear, group.fitted, ~group.verdict.blurred)
    closed = not np.array_equal(good, group.fitted)
    settled = _again(group, good) if closed else group
    for round_ in range(_ROUNDS):
        good = settled.verdict.good
        if closed or (round_ and len(good) < (1 - _FEW) * count):
            good = np.intersect1d(good, settled.fitted)
        if len(good) < _FEWEST:
            raise PosesDisagreeError(f"Only {len(good)} of {count} views agree; {_FEWEST} are needed.")
        if np.array_equal(good, settled.fitted):
            break
        settled = _again(settled, good)
    return settled


def _judged(everything: Observations, fitted: Places, result: Estimate, boards: BoardPoses) -> Settled:
    boards = _boards_seen_by(result, everything, boards)
    verdict = judge_views(everything, result, boards, fitted)
    return Settled(everything, fitted, fitted, result, verdict, boards)


def _boards_seen_by(result: Estimate, everything: Observations, before: BoardPoses) -> BoardPoses:
    """Sought from those before, which another lens hardly moves and nothing else does."""
    if not result.intrinsics_free:
        return before
    return refine_board_poses(everything, replace(result.state, C=before.C))


def _again(settled: Settled, fitted: Places) -> Settled:
    """Estimated by other views."""
    before = settled.estimate
    start = replace(before.state, C=settled.boards.C[fitted])
    observed = settled.everything.part(fitted)
    result = estimate(observed, start, before.intrinsics_free, before.sigma)
    return _judged(settled.everything, fitted, result, settled.boards)


def _with_kinematics(
    views: ViewSet, group: Settled, plain: Settled, prior: KinematicPrior, reject: bool
) -> tuple[RobotSystematics | None, Settled]:
    """The finding, and the estimate that counts: with the kinematic model where it is due.

    With the model, views are judged again: some looked wrong only because the arm is. Where many of the group
    were left out and the others do not show it, the whole group is asked, and believed if that explains them.
    """
    derivatives = kinematic_derivatives(views) if len(plain.fitted) >= FEWEST_VIEWS else None
    if derivatives is None:
        return None, plain
    with_table = replace(group.everything, kinematics=derivatives)

    def settle(start: Settled) -> tuple[RobotSystematics, Settled | None]:
        fitted = fit_kinematics(start.observed, start.estimate, derivatives[start.fitted])
        if prior == "off" or not (fitted.finding.possible or prior == "on"):
            return fitted.finding, None
        settled = _settle(_judged(with_table, start.fitted, fitted.estimate, start.boards), reject)
        table_errors = tuple((UNIT * settled.estimate.state.theta).tolist())
        return replace(fitted.finding, prior_applied=True, table_errors=table_errors), settled

    finding, settled = settle(plain)
    most = (1 - _FEW) * len(group.fitted)
    if not finding.detected and len(plain.fitted) < most:
        of_all, explained = settle(group)
        if of_all.detected and explained is not None and len(explained.fitted) >= most:
            return of_all, explained
    return finding, settled or plain


def _with_worths(settled: Settled) -> Settled:
    """Estimated also by what the bad views are worth, at the noise scales of the good ones.

    A view that came within the limit may be bad by all that is known of the kinds.
    """
    usable = ~settled.verdict.blurred
    if len(settled.places) == usable.sum():
        return settled
    found = number_worths(settled.verdict.linear, settled.places, usable)
    good = np.setdiff1d(settled.places, found.bad)
    places = good if len(good) >= _FEWEST else settled.places
    everything = replace(settled.everything, worth=found.worth)
    fitted = np.flatnonzero(found.worth.any(axis=1))
    before = settled.estimate
    start = replace(before.state, C=settled.boards.C[fitted])
    result = estimate(everything.part(fitted), start, before.intrinsics_free, before.sigma, fit_scales=False)
    result = replace(result, joint_covariance=widen(result.joint_covariance, found.lost))
    boards = _boards_seen_by(result, everything, settled.boards)
    doubts = {int(i): float(found.chance_bad[i]) for i in places if found.chance_bad[i]}
    return Settled(everything, places, fitted, result, settled.verdict, boards, doubts)


def _require_plausible_noise(result: Estimate) -> None:
    robot_m, robot_rad = float(result.sigma[1]), float(result.sigma[2])
    if robot_m > MAX_ROBOT_M or robot_rad > MAX_ROBOT_RAD:
        raise PosesDisagreeError(
            f"Robot and pictures disagree by {robot_m * 1e3:.0f} mm, {np.degrees(robot_rad):.1f}° per axis."
        )
