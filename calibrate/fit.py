"""The robust profile's fit: consensus, maximum likelihood, and verdicts until neither changes the other."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.board_poses import BoardPoses, refine_board_poses
from calibrate.consensus import Consensus, disagreement, find_consensus, pose_arrays
from calibrate.estimate import Estimate, estimate, first_state
from calibrate.likelihood.model import Observations, State, observe_views
from calibrate.outliers import Judgement, explain, judge_views
from calibrate.pairs import Pairs, Places, all_pairs
from calibrate.robust import GlobalResult, solve_global
from calibrate.solution import RejectedView
from calibrate.stopwatch import Stopwatch
from calibrate.views import ViewSet

_ROUNDS = 5
_FEWEST = 4
MAX_ROBOT_M = 0.03
MAX_ROBOT_RAD = np.radians(3.0)
"""Beyond this per axis it is not noise: no X is returned."""


@dataclass(frozen=True, eq=False)
class Fit:
    consensus: Consensus
    views: ViewSet
    """All views, turned boards set right."""
    places: Places
    """Those that the estimate rests on."""
    observed: Observations
    """Of those."""
    estimate: Estimate
    verdict: Judgement
    boards: BoardPoses
    """Of all views, by their own corners and the final lens."""
    rejected: tuple[RejectedView, ...]
    pairs: Pairs
    """All pairs of the kept views, board poses by the final lens."""
    certified: GlobalResult
    """Global optimum over those pairs."""


def fit_views(views: ViewSet, seed: int, intrinsics_free: bool, reject: bool, watch: Stopwatch) -> Fit:
    """At most 5 rounds of estimate and verdict: bounded time."""
    consensus = find_consensus(views, seed, reject)
    watch.lap("certified optimum")
    views, places, X = consensus.views, consensus.places, consensus.start.X
    everything = observe_views(views)
    camera = views.camera
    seen: list[tuple[int, ...]] = []
    for _ in range(_ROUNDS):
        seen.append(tuple(places.tolist()))
        observed = observe_views(views.select(places.tolist()))
        H, C = pose_arrays(views)
        result = estimate(observed, first_state(observed, X, C[places], H[places], camera), intrinsics_free)
        boards, verdict = _judge(everything, views, result)
        X, camera = result.state.X, result.state.camera
        good = verdict.good if reject else places
        if np.array_equal(good, places) or tuple(good.tolist()) in seen:
            break
        if len(good) < _FEWEST:
            raise disagreement(f"Only {len(good)} of {len(views)} views agree; {_FEWEST} are needed.")
        places = good
    watch.lap("maximum likelihood")
    _require_plausible_noise(result)
    bad = np.setdiff1d(np.arange(len(views)), places)
    state = _full_state(result.state, boards)
    rejected = explain(views, state, verdict, bad)
    watch.lap("verdicts")
    pairs = all_pairs(H[places], boards.C[places])
    problem = f"chordal objective over all {len(pairs)} pairs of the {len(places)} used views"
    certified = solve_global(pairs, seed, problem)
    watch.lap("certified optimum")
    return Fit(consensus, views, places, observed, result, verdict, boards, rejected, pairs, certified)


def _require_plausible_noise(result: Estimate) -> None:
    robot_m, robot_rad = float(result.sigma[1]), float(result.sigma[2])
    if robot_m > MAX_ROBOT_M or robot_rad > MAX_ROBOT_RAD:
        raise disagreement(
            f"Robot poses and pictures disagree by {robot_m * 1e3:.0f} mm and {np.degrees(robot_rad):.1f}° per axis."
        )


def _judge(everything: Observations, views: ViewSet, result: Estimate) -> tuple[BoardPoses, Judgement]:
    state = replace(result.state, C=views.camera_from_board)
    boards = refine_board_poses(everything, state)
    return boards, judge_views(everything, state, boards, result.sigma, len(result.state.C))


def _full_state(state: State, boards: BoardPoses) -> State:
    return replace(state, C=boards.C)
