"""Quick fit of X and the board's pose from poses alone, without corners.

It starts where most views agree and maximises the likelihood of `linear`. It takes milliseconds, so that many
interpretations of one recording (`readings`) can be compared by their evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.cell_state import Quadratic, flange_derivatives
from calibrate.handeye.corner_modes import CornerModes
from calibrate.handeye.linear import MAX_STEPS, Linear, LinearSolution
from calibrate.handeye.metrics import mean_pose
from calibrate.handeye.noise_scales import Scales
from calibrate.handeye.reprojection import linearise_corners
from calibrate.views.projection import intrinsics_vector
from calibrate.views.view_set import Places, ViewSet, implied_flange, observe_views
from recordings.geometry import Array, difference, inverse, perturb, pose, rotation_log
from recordings.schema.messages import Mount

_SUBSETS, _SUBSET_VIEWS = 120, 4
"""Subsets, and views in each. Where 45 % of the views are wrong, the four are right in one subset of eleven,
and in none of 120 once in 100,000 recordings."""
_VOTERS = 60
"""Most views, evenly spread, that candidates are compared by."""
_SHARE = 0.55
"""Share of the views that have to agree with a start."""
FREE = 1.0
"""1σ, relative, of a factor about which nothing is known."""
_LEVER_M = 0.5
"""Lever by which rotations are converted to lengths."""

Moved = Literal["camera", "board"]


@dataclass(frozen=True, eq=False)
class BoardPoses:
    """camera_from_board of every view, and unknown factors (board size, focal length) that change it."""

    C: Array
    """(n, 4, 4) with every factor 1."""
    motion: Array
    """(p, n, 6) motion [δt, δφ] of each pose by each factor."""
    sigma: Array
    """(p,) 1σ of each factor about 1."""

    @classmethod
    def known(cls, C: Array) -> BoardPoses:
        return cls(C, np.zeros((0, len(C), 6)), np.zeros(0))

    def at(self, factors: Array) -> Array:
        """Compute the poses (..., n, 4, 4) for factors (..., p)."""
        return perturb(self.C, np.einsum("...p,pni->...ni", factors - 1.0, self.motion))

    def part(self, places: Places) -> BoardPoses:
        return replace(self, C=self.C[places], motion=self.motion[:, places])

    @property
    def open(self) -> Places:
        """Indices of the factors about which nothing is known: they do not start at 1."""
        return np.flatnonzero(self.sigma >= FREE)


@dataclass(frozen=True, eq=False)
class Start:
    X: Array
    """(4, 4)"""
    Y: Array
    """(4, 4) pose of the board: base_from_board or flange_from_board"""
    factors: Array
    """(p,)"""


def agreed_start(H: Array, boards: BoardPoses, seed: int, candidate: Array | None = None) -> Start:
    """Find the X, board pose and factors on which the largest part of the views agrees best.

    H: (n, 4, 4) robot poses by `pairs.mount_poses`. Park and Martin's method (1994) finds an X from each of
    many subsets of four views. With each X every view gives a board pose; the X wins whose board poses lie
    closest together: with the smallest ball, about one of them, that holds 55 % of them. `candidate`: a
    further X (4, 4) to compare.
    """
    n = len(H)
    rng = np.random.default_rng(seed)
    subsets = np.arange(n)[None]
    if n > _SUBSET_VIEWS:
        subsets = np.array([rng.permutation(n)[:_SUBSET_VIEWS] for _ in range(_SUBSETS)])
    Xs, factors = _of_subsets(H, boards, subsets)
    if candidate is not None:
        Xs = np.concatenate([candidate[None], Xs])
        factors = np.concatenate([np.ones((1, len(boards.sigma))), factors])
    voters = np.unique(np.linspace(0, n - 1, min(n, _VOTERS)).astype(np.intp))
    judged = boards.part(voters)
    chosen = _reach(H[voters] @ Xs[:, None] @ judged.at(factors)).min(axis=1).argmin()
    X, factor = Xs[chosen], factors[chosen]
    return Start(X, central_pose(H @ X @ boards.at(factor)), factor)


def _of_subsets(H: Array, boards: BoardPoses, subsets: Places) -> tuple[Array, Array]:
    """Compute X (s, 4, 4) and factors (s, p) from each subset (s, 4) of views that determines them."""
    first, second = np.array(list(combinations(range(subsets.shape[1]), 2))).T
    i, j = subsets[:, first], subsets[:, second]
    A = inverse(H[j]) @ H[i]
    R_C, t_C = boards.C[:, :3, :3], boards.C[:, :3, 3]
    R_B = R_C[j] @ np.swapaxes(R_C[i], -1, -2)
    alpha, beta = rotation_log(A[..., :3, :3]), rotation_log(R_B)
    U, singular, Vt = np.linalg.svd(np.einsum("spi,spj->sij", alpha, beta))
    D = np.broadcast_to(np.eye(3), U.shape).copy()
    D[:, 2, 2] = np.linalg.det(U @ Vt)
    R = (U @ D @ Vt)[:, None]

    def shift(t: Array) -> Array:
        """Compute B's translation for translations t (n, 3) of the board poses, transformed by X."""
        return np.asarray((R @ (t[j] - (R_B @ t[i][..., None])[..., 0])[..., None])[..., 0])

    free = boards.motion[boards.open, :, :3]
    columns = [A[..., :3, :3] - np.eye(3), *(-shift(t)[..., None] for t in free)]
    J = np.concatenate(columns, axis=-1).reshape(len(subsets), -1, 3 + len(free))
    right = (shift(t_C - free.sum(axis=0)) - A[..., :3, 3]).reshape(len(subsets), -1, 1)
    J_t = np.swapaxes(J, 1, 2)
    N = J_t @ J
    clear = (singular[:, 1] > 1e-6) & (np.linalg.eigvalsh(N)[:, 0] > 1e-8)
    if not clear.any():
        clear[:] = True
        N = N + 1e-6 * np.eye(N.shape[1])
    found = np.linalg.solve(N[clear], (J_t @ right)[clear])[..., 0]
    factors = np.ones((len(found), len(boards.sigma)))
    factors[:, boards.open] = found[:, 3:]
    positive = (factors > 0).all(axis=1)
    if not positive.any():
        raise np.linalg.LinAlgError("no factor above zero fits")
    return pose(R[clear, 0], found[:, :3])[positive], factors[positive]


def central_pose(places: Array) -> Array:
    """Average the poses nearest to the most central one of `places` (n, 4, 4) → (4, 4)."""
    some = places[:: 1 + len(places) // (4 * _VOTERS)]
    middle = some[int(_reach(some).argmin())]
    near = np.argsort(pose_distances(places, middle[None])[:, 0], kind="stable")[: _quorum(len(places)) + 1]
    return mean_pose(places[near])


def _quorum(count: int) -> int:
    return min(count - 1, int(np.ceil(_SHARE * count)))


def _reach(places: Array) -> Array:
    """Compute the distance (..., n) within which each place has `_SHARE` of the others."""
    quorum = _quorum(places.shape[-3])
    return np.asarray(np.partition(pose_distances(places, places), quorum, axis=-1)[..., quorum])


def pose_distances(first: Array, second: Array) -> Array:
    """Compute distances (..., n, m) of each pose to each: metres, and radians times `_LEVER_M`."""
    shift = np.linalg.norm(first[..., :, None, :3, 3] - second[..., None, :, :3, 3], axis=-1)
    R, Q = (places[..., :3, :3].reshape(*places.shape[:-2], 9) for places in (first, second))
    cosine = (R @ np.swapaxes(Q, -1, -2) - 1) / 2
    return np.asarray(shift + _LEVER_M * np.arccos(np.clip(cosine, -1.0, 1.0)))


_SETTLED = 0.3
"""Step length, in sigmas, below which the fit has converged: the evidence need not be exact."""


@dataclass(frozen=True, eq=False)
class PoseViews:
    """The recording with each image reduced to a board pose: made of a `ViewSet`, it holds no corners."""

    mount: Mount
    flange: Array
    """(n, 4, 4) base_from_flange"""
    boards: BoardPoses
    covariance: Array
    """(n, 6, 6) of the board poses."""
    later: NDArray[np.bool_] | None = None
    """(n,) mask of the views after camera or board was moved; None where nothing was."""
    moved: Moved = "board"
    """Camera (X has a second value) or board (Y has)."""
    corner_px: float = 0.0
    """Noise of a corner per axis, by what the images left; 0: there are none."""

    def __len__(self) -> int:
        return len(self.flange)

    def part(self, places: Places) -> PoseViews:
        return replace(
            self,
            flange=self.flange[places],
            boards=self.boards.part(places),
            covariance=self.covariance[places],
            later=None if self.later is None else self.later[places],
        )


def pose_views(views: ViewSet, focal_sigma: float, size_sigma: float) -> PoseViews:
    """Reduce views with `camera_from_board`; 1σ of focal length and board size are relative.

    Two factors move the board poses: true over assumed size of the board, and focal length.
    """
    observed, C = observe_views(views), views.camera_from_board
    size = np.concatenate([C[:, :3, 3], np.zeros((len(C), 3))], axis=1)
    if not observed.has_pixels:
        return PoseViews(
            views.mount,
            observed.flange,
            BoardPoses(C, size[None], np.array([size_sigma])),
            np.zeros((len(C), 6, 6)),
        )
    blocks = linearise_corners(observed, views.camera, C, observed.present, with_lens=True)
    U = np.asarray(np.linalg.inv(blocks.LL), dtype=float)
    modes = CornerModes.of(blocks, U, slice(0))
    focal = -modes.free.by_shared[..., :2] @ intrinsics_vector(views.camera)[:2]
    boards = BoardPoses(C, np.stack([size, focal]), np.array([size_sigma, focal_sigma]))
    corner_px = modes.typical_px
    return PoseViews(views.mount, observed.flange, boards, corner_px**2 * U, corner_px=corner_px)


@dataclass(frozen=True, eq=False)
class PoseFit:
    X: Array
    """(m, 4, 4), m = 2 where the camera was moved."""
    Y: Array
    """(m, 4, 4), m = 2 where the board was moved."""
    factors: Array
    """(p,) as in `BoardPoses`."""
    solved: LinearSolution

    @property
    def log_evidence(self) -> float:
        return self.solved.log_evidence

    @property
    def full(self) -> Array:
        """Probability (n,) that a view is an ordinary one."""
        return self.solved.chances[:, 0]


def fit_poses(views: PoseViews, seed: int = 0) -> PoseFit:
    """Find the most likely X, board pose and factors. LinAlgError where the views determine none."""
    X, Y, factors = _start(views, seed)
    scales: Scales | None = None
    for _ in range(MAX_STEPS):
        linear = linearise(views, X, Y, factors)
        scales = scales or linear.first_scales()
        solved = linear.solve(pose_prior(views.boards, len(X) + len(Y), factors), scales, "robot")
        scales, step = solved.scales, solved.step
        at_Y, at_factors = 6 * len(X), 6 * (len(X) + len(Y))
        X = perturb(X, step[:at_Y].reshape(-1, 6))
        Y = perturb(Y, step[at_Y:at_factors].reshape(-1, 6))
        factors = factors + step[at_factors:]
        if np.sqrt(step @ solved.precision @ step) < _SETTLED:
            break
    return PoseFit(X, Y, factors, solved)


def _start(views: PoseViews, seed: int) -> tuple[Array, Array, Array]:
    H = mount_poses(views.flange, views.mount)
    if views.later is None:
        start = agreed_start(H, views.boards, seed)
        return start.X[None], start.Y[None], start.factors
    parts = np.flatnonzero(~views.later), np.flatnonzero(views.later)
    larger = int(len(parts[1]) > len(parts[0]))
    start = agreed_start(H[parts[larger]], views.boards.part(parts[larger]), seed)
    C = views.boards.at(start.factors)
    other = parts[1 - larger]
    if views.moved == "board":
        second, first = central_pose(H[other] @ start.X @ C[other]), start.Y
    else:
        second, first = central_pose(inverse(H[other]) @ start.Y @ inverse(C[other])), start.X
    both = np.array([first, second] if larger == 0 else [second, first])
    if views.moved == "board":
        return start.X[None], both, start.factors
    return both, start.Y[None], start.factors


def pose_prior(boards: BoardPoses, poses: int, factors: Array) -> Quadratic:
    """Make the prior of X and Y (1 m, 1 rad) and of the factors; `BoardPoses.open` ones have none."""
    precision = np.concatenate([np.full(6 * poses, 1e-6), boards.sigma**-2.0])
    precision[6 * poses + boards.open] = 1e-9
    miss = np.concatenate([np.zeros(6 * poses), factors - 1.0])
    width = boards.sigma.copy()
    width[boards.open] = np.abs(factors[boards.open])
    log = -0.5 * float((precision * miss**2).sum()) - float(np.log(width).sum())
    return Quadratic(np.diag(precision), -precision * miss, log)


def linearise(views: PoseViews, X: Array, Y: Array, factors: Array) -> Linear:
    n = len(views)
    later = np.zeros(n, dtype=np.intp) if views.later is None else views.later.astype(np.intp)
    of_X, of_Y = later * (len(X) > 1), later * (len(Y) > 1)
    C = views.boards.at(factors)
    m = difference(implied_flange(views.mount, X[of_X], Y[of_Y], C), views.flange)
    by_X, by_Y, J_C = flange_derivatives(views.mount, X[of_X], Y[of_Y], C, m)
    columns = [np.where((of_X == part)[:, None, None], by_X, 0.0) for part in range(len(X))]
    columns += [np.where((of_Y == part)[:, None, None], by_Y, 0.0) for part in range(len(Y))]
    columns += [J_C @ motion[..., None] for motion in views.boards.motion]
    return Linear(views.covariance, J_C, m, np.concatenate(columns, axis=2))
