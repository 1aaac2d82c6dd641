"""Where an estimate starts: an X and a board pose that most views agree on, whatever the others say."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calibrate.geometry import Array, inverse, perturb, pose, project_to_rotation, rotation_log
from calibrate.handeye.observations import Places

_SUBSETS, _OF = 120, 4
_VOTERS = 60
"""Of more views, this many judge, evenly spread."""
_SHARE = 0.55
"""Of the views that have to agree."""
_OPEN = 0.1
_LEVER_M = 0.5
"""Turns a rotation into a length."""


@dataclass(frozen=True, eq=False)
class BoardPoses:
    """camera_from_board of every view, and factors of the camera or the board that move them."""

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
        """(n, 4, 4) for factors (p,)."""
        return perturb(self.C, np.einsum("p,pni->ni", factors - 1.0, self.motion))

    def part(self, places: Places) -> BoardPoses:
        return replace(self, C=self.C[places], motion=self.motion[:, places])

    @property
    def open(self) -> Places:
        """Factors of which so little is known that a start must find them."""
        return np.flatnonzero(self.sigma > _OPEN)


@dataclass(frozen=True, eq=False)
class Start:
    X: Array
    """(4, 4)"""
    Y: Array
    """(4, 4) pose of the board"""
    factors: Array
    """(p,)"""


def agreed_start(H: Array, boards: BoardPoses, seed: int, candidate: Array | None = None) -> Start:
    """The X, board pose and factors on which the largest part of the views agrees best.

    H as in `pairs`, (n, 4, 4). Park and Martin's method (1994) on subsets of four views; the one with the
    least 55 % quantile of the distance from the most central board pose wins. `candidate`: an X (4, 4) that
    takes part.
    """
    n = len(H)
    rng = np.random.default_rng(seed)
    subsets = np.array([rng.permutation(n)[:_OF] for _ in range(_SUBSETS)]) if n > _OF else np.arange(n)[None]
    Xs, factors = _of_subsets(H, boards, subsets)
    if candidate is not None:
        Xs = np.concatenate([candidate[None], Xs])
        factors = np.concatenate([np.ones((1, len(boards.sigma))), factors])
    voters = np.unique(np.linspace(0, n - 1, min(n, _VOTERS)).astype(np.intp))
    judged = boards.part(voters)
    best, chosen = np.inf, 0
    for place, (X, factor) in enumerate(zip(Xs, factors, strict=True)):
        reach = float(_reach(H[voters] @ X @ judged.at(factor)).min())
        if reach < best:
            best, chosen = reach, place
    X, factor = Xs[chosen], factors[chosen]
    return Start(X, central_pose(H @ X @ boards.at(factor)), factor)


def _of_subsets(H: Array, boards: BoardPoses, subsets: Places) -> tuple[Array, Array]:
    """X (s, 4, 4) and factors (s, p) by each subset (s, 4) of the views that tells them."""
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
        """Translation of B for translations t (n, 3) of the board poses, seen through X."""
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
    """(4, 4): the mean of those of `places` (n, 4, 4) that are nearest to the most central one."""
    some = places[:: 1 + len(places) // (4 * _VOTERS)]
    middle = some[int(_reach(some).argmin())]
    near = np.argsort(_distance(places, middle[None])[:, 0], kind="stable")[: _quorum(len(places)) + 1]
    return pose(project_to_rotation(places[near, :3, :3].mean(axis=0)), places[near, :3, 3].mean(axis=0))


def _quorum(count: int) -> int:
    return min(count - 1, int(np.ceil(_SHARE * count)))


def _reach(places: Array) -> Array:
    """(n,) distance within which each place has its share of the others."""
    quorum = _quorum(len(places))
    return np.asarray(np.partition(_distance(places, places), quorum, axis=1)[:, quorum])


def _distance(first: Array, second: Array) -> Array:
    """(n, m) between poses: metres, and radians at half a metre."""
    shift = np.linalg.norm(first[:, None, :3, 3] - second[None, :, :3, 3], axis=-1)
    R, Q = first[:, :3, :3].reshape(-1, 9), second[:, :3, :3].reshape(-1, 9)
    return np.asarray(shift + _LEVER_M * np.arccos(np.clip((R @ Q.T - 1) / 2, -1.0, 1.0)))
