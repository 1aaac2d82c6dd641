"""Relative motions: from poses of the arm and of the board to pairs with A X = X B.

One convention for both mounts. With H = base_from_flange (eye-in-hand) or H = (base_from_flange)⁻¹
(eye-to-hand), C = camera_from_board and Y constant, H_i X C_i = Y for every view, so that
A = H_j⁻¹ H_i and B = C_j C_i⁻¹ (paper eqs. 1-3 and 21; the blog's two derivations).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recordings.geometry import Array, inverse, rotation_log
from recordings.schema.messages import Mount

Places = NDArray[np.intp]

MAX_PAIRS = 20_000
"""Most pairs made; beyond it they are thinned evenly, so that memory and time stay bounded."""


@dataclass(frozen=True, eq=False)
class Pairs:
    A: Array
    """(n, 4, 4) motion of the mount."""
    B: Array
    """(n, 4, 4) motion of the camera."""
    first: Places
    """(n,) place of the earlier view i."""
    second: Places
    """(n,) place of the later view j."""

    def __len__(self) -> int:
        return len(self.A)

    @cached_property
    def alpha(self) -> Array:
        """(n, 3) logarithms of A's rotations (eq. 12), rad."""
        return rotation_log(self.A[:, :3, :3])

    @cached_property
    def beta(self) -> Array:
        """(n, 3) logarithms of B's rotations, rad."""
        return rotation_log(self.B[:, :3, :3])

    def select(self, places: Places | NDArray[np.bool_] | slice) -> Pairs:
        return Pairs(self.A[places], self.B[places], self.first[places], self.second[places])


def mount_poses(base_from_flange: Array, mount: Mount) -> Array:
    """Return H (n, 4, 4) of the one convention above."""
    return base_from_flange if mount == "eye-in-hand" else inverse(base_from_flange)


def make_pairs(H: Array, camera_from_board: Array, first: Places, second: Places) -> Pairs:
    """Make pairs (first → second) of views; H and camera_from_board (n, 4, 4)."""
    A = inverse(H[second]) @ H[first]
    B = camera_from_board[second] @ inverse(camera_from_board[first])
    return Pairs(A, B, first, second)


def consecutive_pairs(H: Array, camera_from_board: Array) -> Pairs:
    """Pair each view with its successor (eq. 21): n - 1 pairs."""
    first = np.arange(len(H) - 1)
    return make_pairs(H, camera_from_board, first, first + 1)


def all_pairs(H: Array, camera_from_board: Array, limit: int = MAX_PAIRS) -> Pairs:
    """Pair every view with every later one, n(n-1)/2 pairs; above `limit`, each with evenly spread others."""
    n = len(H)
    if n * (n - 1) // 2 <= limit:
        first, second = np.triu_indices(n, 1)
    else:
        steps = np.unique(np.linspace(1, n // 2, max(3, limit // n)).astype(int))
        i = np.repeat(np.arange(n), len(steps))
        j = (i + np.tile(steps, n)) % n
        first, second = np.minimum(i, j), np.maximum(i, j)
    return make_pairs(H, camera_from_board, first, second)


def screw_invariants(motion: Array) -> tuple[Array, Array]:
    """Compute angle (...) rad and translation along the axis (...) m of motions (..., 4, 4).

    Both are the same for A and B of a right pair, whatever X is (Chen 1991). The pitch of a motion that
    does not rotate is its length.
    """
    log, t = rotation_log(motion[..., :3, :3]), motion[..., :3, 3]
    angle = np.linalg.norm(log, axis=-1)
    along = (log * t).sum(axis=-1) / np.maximum(angle, 1e-12)
    return angle, np.where(angle > 1e-9, along, np.linalg.norm(t, axis=-1))
