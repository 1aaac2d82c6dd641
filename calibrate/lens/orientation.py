"""Which of several readings of each picture is right: the one that agrees with the robot's motion.

For the right reading of two views the robot's and the board's relative motions A and B are the same screw:
equal angles, equal translations along the axis, whatever X is. So every pair of readings can be scored
without knowing X.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array, inverse, rotation_log
from recordings.schema.messages import Mount

ANGLE_SCALE_RAD = 0.01
PITCH_SCALE_M = 0.005
_LARGEST_VOTERS = 120


def choose_candidates(candidates: list[Array], base_from_flange: Array, mount: Mount) -> list[int]:
    """Per view the number of the reading to keep.

    candidates: n arrays (k_i, 4, 4) camera_from_board; base_from_flange: (n, 4, 4). At most 120 views, evenly
    spread, vote; the others follow them, so the work is bounded. Best of all starts of iterated conditional
    modes (J. Besag, 1986), each start holding one reading of one view.
    """
    count = len(candidates)
    voters = np.unique(np.linspace(0, count - 1, min(count, _LARGEST_VOTERS)).astype(int))
    owner = np.concatenate([np.full(len(candidates[v]), n) for n, v in enumerate(voters)])
    cost = _pair_costs(
        np.concatenate([candidates[v] for v in voters]),
        np.repeat(base_from_flange[voters], [len(candidates[v]) for v in voters], axis=0),
        mount,
    )
    cost[owner[:, None] == owner[None, :]] = 0.0
    starts = np.array([np.flatnonzero(owner == n)[0] for n in range(len(voters))])
    best, best_cost = starts, np.inf
    for start in range(len(owner)):
        labels = _settle(cost, owner, len(voters), start)
        total = float(cost[np.ix_(labels, labels)].sum())
        if total < best_cost - 1e-9:
            best, best_cost = labels, total
    kept = {int(v): int(best[n] - starts[n]) for n, v in enumerate(voters)}
    anchor_poses = np.array([candidates[v][k] for v, k in kept.items()])
    anchor_flanges = base_from_flange[list(kept)]
    for i in set(range(count)) - set(kept):
        votes = [_vote(c, base_from_flange[i], anchor_poses, anchor_flanges, mount) for c in candidates[i]]
        kept[i] = int(np.argmin(votes))
    return [kept[i] for i in range(count)]


def _settle(cost: Array, owner: NDArray[np.intp], views: int, start: int) -> NDArray[np.intp]:
    """Labels as row numbers of `cost`, one per view."""

    def cheapest(column: Array) -> NDArray[np.intp]:
        order = np.lexsort((np.arange(len(owner)), column, owner))
        first = np.searchsorted(owner[order], np.arange(views))
        return np.asarray(order[first])

    column = cost[:, start].copy()
    column[start] = -1.0
    labels = cheapest(column)
    for _ in range(20):
        following = cheapest(cost[:, labels].sum(axis=1))
        if (following == labels).all():
            break
        labels = following
    return labels


def _pair_costs(poses: Array, flanges: Array, mount: Mount) -> Array:
    """(m, m) in 0 … 1 (Geman-McClure) for every two of m readings."""
    A = _relative_motions(flanges, mount)
    B = poses[None, :] @ inverse(poses)[:, None]
    return _screw_cost(A, B)


def _relative_motions(flanges: Array, mount: Mount) -> Array:
    if mount == "eye-in-hand":
        return np.asarray(inverse(flanges)[None, :] @ flanges[:, None])
    return np.asarray(flanges[None, :] @ inverse(flanges)[:, None])


def _vote(pose: Array, flange: Array, poses: Array, flanges: Array, mount: Mount) -> float:
    if mount == "eye-in-hand":
        A = inverse(flanges) @ flange
    else:
        A = flanges @ inverse(flange)
    return float(_screw_cost(A, poses @ inverse(pose)).sum())


def _screw_cost(A: Array, B: Array) -> Array:
    alpha, beta = rotation_log(A[..., :3, :3]), rotation_log(B[..., :3, :3])
    angle_a, angle_b = np.linalg.norm(alpha, axis=-1), np.linalg.norm(beta, axis=-1)
    along_a = (alpha * A[..., :3, 3]).sum(axis=-1) / np.maximum(angle_a, 1e-9)
    along_b = (beta * B[..., :3, 3]).sum(axis=-1) / np.maximum(angle_b, 1e-9)
    # The axis of a small turn is not known, nor is the sign of that of a half turn.
    trust = np.minimum(1.0, np.minimum(angle_a, angle_b) / 0.2)
    pitch_miss = np.abs(along_a - along_b)
    pitch_miss = np.where(
        angle_a > np.pi - 0.1, np.minimum(pitch_miss, np.abs(along_a + along_b)), pitch_miss
    )
    square = ((angle_a - angle_b) / ANGLE_SCALE_RAD) ** 2 + (trust * pitch_miss / PITCH_SCALE_M) ** 2
    return np.asarray(square / (1.0 + square))
