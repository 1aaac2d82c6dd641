"""Which views agree with each other, before any X is known.

For a right pair A and B are the same screw: equal angle, equal translation along the axis, whatever X is
(Chen 1991). The scale of "equal" adapts to the recording, and the largest group of views that agree pair by
pair is kept. Up to MAX_VOTERS views vote, evenly spread; bounded time for thousands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array
from calibrate.pairs import Pairs, Places, make_pairs, screw_invariants

MAX_VOTERS = 150
_FLOOR = np.array([2e-5, 2e-5])
"""rad, m: agreement is never asked to be closer than this."""
_CEILING = np.array([0.05, 0.1])
"""rad, m: nor does anything beyond this pass for noise."""
_AGREE = 4.5
"""Scales within which a pair agrees."""
_MEMBER = 0.6
"""Share of a group with which its members must agree."""


@dataclass(frozen=True, eq=False)
class Screening:
    group: Places
    """Places of the views that agree with each other."""
    voters: Places
    scale_rad: float
    """Noise of a pair's rotation, as the agreeing pairs show it."""

    @property
    def share(self) -> float:
        return len(self.group) / max(len(self.voters), 1)


def screen(H: Array, camera_from_board: Array) -> Screening:
    """Largest agreeing group of views; H as in `pairs`."""
    n = len(H)
    voters = np.unique(np.linspace(0, n - 1, min(n, MAX_VOTERS)).astype(np.intp))
    first, second = np.triu_indices(len(voters), 1)
    pairs = make_pairs(H[voters], camera_from_board[voters], first, second)
    misses = _misses(pairs)
    scale = _adaptive_scale(misses)
    agree = (misses < _AGREE * scale).all(axis=1)
    matrix = np.eye(len(voters), dtype=bool)
    matrix[first, second] = matrix[second, first] = agree
    group = _largest_group(matrix)
    return Screening(voters[group], voters, float(scale[0]))


def detect_shift(H: Array, camera_from_board: Array) -> int:
    """Is every picture stored with a neighbour's pose? 0, or s: view i's picture belongs to pose i + s.

    A shift counts only when it makes most pairs agree that do not agree as recorded.
    """
    if len(H) < 6:
        return 0
    as_recorded = screen(H, camera_from_board)
    if as_recorded.share > 0.6 and as_recorded.scale_rad < _CEILING[0] / 2:
        return 0
    best, best_share = 0, max(0.75, 1.5 * as_recorded.share)
    for shift in (-2, -1, 1, 2):
        poses, pictures = H[max(shift, 0) :], camera_from_board[max(-shift, 0) :]
        count = min(len(poses), len(pictures))
        shifted = screen(poses[:count], pictures[:count])
        if shifted.share > best_share and shifted.scale_rad < as_recorded.scale_rad:
            best, best_share = shift, shifted.share
    return best


def _misses(pairs: Pairs) -> Array:
    """(n, 2): difference of angles, rad, and of pitches, m (less trusted for small turns)."""
    angle_A, pitch_A = screw_invariants(pairs.A)
    angle_B, pitch_B = screw_invariants(pairs.B)
    pitch = np.abs(pitch_A - pitch_B)
    near_pi = np.maximum(angle_A, angle_B) > np.pi - 0.05
    pitch = np.where(near_pi, np.minimum(pitch, np.abs(pitch_A + pitch_B)), pitch)
    trust = np.minimum(1.0, np.minimum(angle_A, angle_B) / 0.3)
    return np.stack([np.abs(angle_A - angle_B), pitch * trust], axis=1)


def _adaptive_scale(misses: Array) -> Array:
    """(2,) standard deviations of the good pairs: from a low quantile, then from what lies within 3 of it.

    The quantile of 20 % is the good pairs' alone down to 36 % good pairs (40 % bad views).
    """
    scale = np.clip(np.quantile(misses, 0.2, axis=0) / 0.25, _FLOOR, _CEILING)
    for _ in range(8):
        inside = misses[(misses < 3 * scale).all(axis=1)]
        if len(inside) < 3:
            break
        updated = np.maximum(np.sqrt((inside**2).mean(axis=0)) * 1.02, _FLOOR)
        if np.allclose(updated, scale, rtol=1e-3):
            break
        scale = np.minimum(updated, scale)
    return np.asarray(scale)


def _largest_group(agree: NDArray[np.bool_]) -> Places:
    """Grown from every view in turn: those that agree with at least _MEMBER of the group."""
    best = np.zeros(0, dtype=np.intp)
    for seed in range(len(agree)):
        inside = agree[seed].copy()
        for _ in range(10):
            votes = agree[:, inside].sum(axis=1)
            updated = votes >= _MEMBER * max(int(inside.sum()), 1)
            if (updated == inside).all():
                break
            inside = updated
        if inside.sum() > len(best):
            best = np.flatnonzero(inside)
    return best
