"""`calibrate compare`: every method of the literature and ours, side by side on the same views."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from scipy import optimize

from calibrate.errors import CalibrationError
from calibrate.handeye.axxb.pairs import Pairs, all_pairs, consecutive_pairs, mount_poses
from calibrate.handeye.axxb.paper import on_box, solve_paper
from calibrate.handeye.axxb.peer_methods import (
    HAND_EYE,
    ROBOT_WORLD,
    heller_global,
    opencv_hand_eye,
    opencv_robot_world,
    orthonormalised,
    strobl_hirzinger,
    zhao_minimax,
    zhi_linear,
)
from calibrate.handeye.blas_threads import one_blas_thread
from calibrate.handeye.cell_state import CellState
from calibrate.handeye.estimate import estimate
from calibrate.handeye.metrics import (
    FEWEST_FITTED,
    HELD_OUT,
    board_spread,
    distance_in_sigmas,
    mean_pose,
    motion_errors,
    require_solvable,
)
from calibrate.handeye.noise_scales import Scales
from calibrate.handeye.priors import BoardTolerance, LensPrior, Priors
from calibrate.handeye.reprojection import corner_residuals
from calibrate.handeye.solution import Solution, SolveOptions
from calibrate.handeye.solve import solve_robust_profile
from calibrate.results import SHAPE
from calibrate.results import PeerResult as PeerResult
from calibrate.views.projection import intrinsics_vector
from calibrate.views.view_set import ViewSet, observe_views
from recordings.geometry import Array, inverse, is_rigid, perturb, rotation_log

Method = Callable[[ViewSet], Array]
HeldOut = tuple[ViewSet, Pairs]
"""The views that are fitted, and all pairs inside the last 6, which score them."""
PAPER = "DE, paper"
_MAX_PAIRS = 2000
_EXACT = 1e-6
"""1σ of robot poses, lens and board that are taken as exact: metres and radians, or relative."""


@one_blas_thread()
def compare_all(views: ViewSet, options: SolveOptions | None = None) -> list[PeerResult]:
    """Run every method, ours last. All get the views that ours keeps (turned boards set right), with the
    board poses of the given intrinsics; e_t and e_R are scored on the last 6 of them, fitted without.
    """
    require_solvable(views)
    options = options or SolveOptions()
    start = time.perf_counter()
    ours = solve_robust_profile(views, options)
    ours_ms = 1e3 * (time.perf_counter() - start)
    kept = replace(views, views=ours.evidence.kept)
    held = _held_out(kept)
    rows = [_row(name, method, kept, held, ours) for name, method in _methods(options).items()]
    final = _scored("ours", ours.matrix, kept, ours)
    if (score := ours.judgement.figures.holdout) is not None:
        final = replace(final, e_t_m=score.e_t_m, e_R=score.e_R)
    return [*rows, replace(final, time_ms=ours_ms, note="time with held-out scores, outliers and proof")]


def _held_out(views: ViewSet) -> HeldOut | None:
    """Hold out the last views; None where too few are left."""
    fitted, (H, C) = len(views) - HELD_OUT, _pose_arrays(views)
    return (
        None
        if fitted < FEWEST_FITTED
        else (views.select([*range(fitted)]), all_pairs(H[fitted:], C[fitted:]))
    )


def _methods(options: SolveOptions) -> dict[str, Method]:
    methods: dict[str, Method] = {}
    for name, number in HAND_EYE.items():
        methods[name] = partial(_by_poses, partial(opencv_hand_eye, method=number))
    for name, number in ROBOT_WORLD.items():
        methods[name] = partial(_by_poses, partial(opencv_robot_world, method=number))
    methods["Zhao CO"] = partial(_by_pairs, zhao_minimax)
    methods["Zhao CO + SVD"] = partial(_by_pairs, lambda pairs: orthonormalised(zhao_minimax(pairs)))
    methods["Zhi-Schwertfeger"] = partial(_by_pairs, zhi_linear)
    methods["Strobl-Hirzinger"] = _strobl
    methods["Heller, certified"] = partial(_by_pairs, heller_global)
    methods["reprojection only"] = _reprojection_only
    methods[PAPER] = partial(_paper, seed=options.seed)
    return methods


def _by_poses(solve: Callable[[Array, Array], Array], views: ViewSet) -> Array:
    return solve(*_pose_arrays(views))


def _by_pairs(solve: Callable[[Pairs], Array], views: ViewSet) -> Array:
    return solve(all_pairs(*_pose_arrays(views), limit=_MAX_PAIRS))


def _strobl(views: ViewSet) -> Array:
    start = _by_poses(partial(opencv_hand_eye, method=HAND_EYE["Park-Martin"]), views)
    return _by_pairs(partial(strobl_hirzinger, start=start), views)


def _paper(views: ViewSet, seed: int) -> Array:
    return solve_paper(consecutive_pairs(*_pose_arrays(views)), seed).X


def _reprojection_only(views: ViewSet) -> Array:
    """Minimise the reprojection error from Park and Martin's X, robot poses and intrinsics taken as exact."""
    observed = observe_views(views)
    if not observed.has_pixels:
        raise CalibrationError("no-corners")
    H, C = _pose_arrays(views)
    X = opencv_hand_eye(H, C, HAND_EYE["Park-Martin"])
    lens = LensPrior.given(views.camera, _EXACT * np.maximum(np.abs(intrinsics_vector(views.camera)), 1.0))
    priors = Priors(lens, BoardTolerance(_EXACT, _EXACT))
    shares = np.array([1.0, *[1e-12] * 3])
    scales = Scales(np.array([_EXACT, _EXACT]), 1.0, 1.0, 1.0, shares)
    Y = mean_pose(H @ X @ C)
    start = CellState(X, Y, C, views.camera, np.zeros(len(SHAPE)), np.zeros(0))
    return estimate(observed, start, priors, scales, fit="nothing").state.X


def _pose_arrays(views: ViewSet) -> tuple[Array, Array]:
    """Return H (n, 4, 4) as in `pairs`, and camera_from_board (n, 4, 4)."""
    return mount_poses(views.base_from_flange, views.mount), views.camera_from_board


def _row(name: str, method: Method, views: ViewSet, held: HeldOut | None, ours: Solution) -> PeerResult:
    start = time.perf_counter()
    try:
        X = method(views)
        elapsed_ms = 1e3 * (time.perf_counter() - start)
        partial_X = X if held is None else method(held[0])
    except (CalibrationError, cv2.error, np.linalg.LinAlgError, ValueError) as error:
        return PeerResult(name, None, note=f"failed: {str(error).splitlines()[0]}")
    if not np.isfinite(X).all():
        return PeerResult(name, None, note="failed: not a number")
    row = replace(_scored(name, X, views, ours), time_ms=elapsed_ms)
    if name == PAPER and (boxed := on_box(np.append(rotation_log(X[:3, :3]), X[:3, 3]))):
        row = replace(row, on_box=boxed, note=f"on the paper's box ({', '.join(boxed)}): X is wrong")
    if held is None or not np.isfinite(partial_X).all():
        return row
    e_t, e_R = motion_errors(partial_X, held[1])
    return replace(row, e_t_m=float(e_t.mean()), e_R=float(e_R.mean()))


def _scored(name: str, X: Array, views: ViewSet, ours: Solution) -> PeerResult:
    rigid = is_rigid(X)
    H, C = _pose_arrays(views)
    spread = board_spread(H, C, X) if rigid else (None, None)
    return PeerResult(
        name=name,
        matrix=X,
        board_spread_m=spread[0],
        board_spread_rad=spread[1],
        reprojection_px=reprojection_px(views, X) if rigid else None,
        distance_sigma=distance_in_sigmas(X, ours.matrix, ours.covariance) if rigid else None,
        rigid=rigid,
        note="" if rigid else "raw matrix, not a rigid transform",
    )


def reprojection_px(views: ViewSet, X: Array) -> float | None:
    """Compute the rms distance over all corners at the best board pose for this X; None without pixels.

    Infinite when corners fall behind the camera.
    """
    observed = observe_views(views)
    if not observed.has_pixels:
        return None
    H, C = _pose_arrays(views)
    camera_from_place = inverse(H @ X)
    Y = mean_pose(H @ X @ C)

    def off(delta: Array) -> Array:
        return corner_residuals(observed, views.camera, camera_from_place @ perturb(Y, delta)).ravel()

    if not np.isfinite(off(np.zeros(6))).all():
        return np.inf
    fit = optimize.least_squares(off, np.zeros(6), x_scale="jac")
    return float(np.sqrt(2 * fit.cost / observed.present.sum()))
