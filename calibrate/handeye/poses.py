"""X and the board's pose from poses alone: the same likelihood, board poses known up to their covariance.

It takes milliseconds, so that many readings of one recording can be compared by their evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array, difference, inverse, perturb
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.corners import linearise_corners
from calibrate.handeye.flange import flange_derivatives, implied_flange
from calibrate.handeye.linear import CornerModes, Linear, LinearSolution, Scales, first_scales
from calibrate.handeye.observations import Moved, Places, observe_views
from calibrate.handeye.priors import Quadratic
from calibrate.handeye.start import BoardPoses, agreed_start, central_pose
from calibrate.projection import intrinsics_vector
from calibrate.views import ViewSet
from recordings.schema.messages import Mount

_STEPS = 8
_SETTLED = 0.3
"""Length of a step, in sigmas: evidence is not asked to be exact."""


@dataclass(frozen=True, eq=False)
class PoseViews:
    """What was recorded, each picture reduced to a board pose."""

    mount: Mount
    flange: Array
    """(n, 4, 4) base_from_flange"""
    boards: BoardPoses
    covariance: Array
    """(n, 6, 6) of the board poses."""
    later: NDArray[np.bool_] | None = None
    """(n,) views after something was moved; None where nothing was."""
    moved: Moved = "board"

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
    """The views with `camera_from_board`; 1σ of the lens' focal length and of the board's size, relative.

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
    H = np.asarray(np.linalg.inv(blocks.LL), dtype=float)
    focal = -(H @ blocks.LG[..., :2]) @ intrinsics_vector(views.camera)[:2]
    modes = CornerModes.of(blocks, H, slice(0))
    boards = BoardPoses(C, np.stack([size, focal]), np.array([size_sigma, focal_sigma]))
    return PoseViews(views.mount, observed.flange, boards, modes.typical_px**2 * H)


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
        """(n,) chance that a view is an ordinary one."""
        return self.solved.chances[:, 0]


def fit_poses(views: PoseViews, seed: int = 0) -> PoseFit:
    """Most likely X, board pose and factors. LinAlgError where the views determine none."""
    X, Y, factors = _start(views, seed)
    scales: Scales | None = None
    for _ in range(_STEPS):
        linear = _linearise(views, X, Y, factors)
        scales = scales or first_scales(linear)
        solved = linear.solve(_prior(views.boards, len(X) + len(Y), factors), scales, "robot")
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


def _prior(boards: BoardPoses, poses: int, factors: Array) -> Quadratic:
    """For `poses` poses, known to a metre and a radian, and the factors: open ones may be of any size."""
    precision = np.concatenate([np.full(6 * poses, 1e-6), boards.sigma**-2.0])
    precision[6 * poses + boards.open] = 1e-9
    miss = np.concatenate([np.zeros(6 * poses), factors - 1.0])
    width = boards.sigma.copy()
    width[boards.open] = np.abs(factors[boards.open])
    log = -0.5 * float((precision * miss**2).sum()) - float(np.log(width).sum())
    return Quadratic(np.diag(precision), -precision * miss, log)


def _linearise(views: PoseViews, X: Array, Y: Array, factors: Array) -> Linear:
    n = len(views)
    later = np.zeros(n, dtype=np.intp) if views.later is None else views.later.astype(np.intp)
    of_X, of_Y = later * (len(X) > 1), later * (len(Y) > 1)
    C = views.boards.at(factors)
    m = difference(implied_flange(views.mount, X[of_X], Y[of_Y], C), views.flange)
    by_X, by_Y, A = flange_derivatives(views.mount, X[of_X], Y[of_Y], C, m)
    columns = [np.where((of_X == part)[:, None, None], by_X, 0.0) for part in range(len(X))]
    columns += [np.where((of_Y == part)[:, None, None], by_Y, 0.0) for part in range(len(Y))]
    columns += [A @ motion[..., None] for motion in views.boards.motion]
    return Linear(views.covariance, A, m, np.concatenate(columns, axis=2))
