"""In which other convention would the robot's poses fit the pictures? So that an error can say what to mend.

Rotation vectors read as Euler angles, quaternions in another order, poses the wrong way round: each gives
rigid poses, and no test of a single one can tell. In the right reading one X puts the board of every view in
one place.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from calibrate.assess import board_places
from calibrate.evolution_robust import solve_geman_mcclure
from calibrate.geometry import (
    Array,
    difference,
    inverse,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_exp,
    rotation_log,
)
from calibrate.pairs import Places, all_pairs, mount_poses
from calibrate.robust import solve_global
from calibrate.views import ViewSet

_VIEWS = 60
"""More are thinned evenly: each convention costs an evolution."""
_MUCH_BETTER = 100.0
"""Times smaller the spread (metres times radians) has to be than with the poses as they were read."""
_CLEAR = 10.0
"""… and than in the next best convention: no advice is better than a wrong one."""


def what_to_mend(views: ViewSet, seed: int) -> str:
    """Two sentences for an error about views that contradict each other."""
    found = fitting_convention(views, seed)
    if found is not None:
        return (
            f"They would agree if the robot poses were {found}. Correct that where the poses come from "
            "(poses.csv, dataset.yaml) and import again."
        )
    return (
        "The robot poses do not belong to these pictures, or are in another convention (rotation vector or "
        "Euler angles, mm or m, flange_from_base instead of base_from_flange), or the mount is wrong. Check "
        "the first rows."
    )


def fitting_convention(views: ViewSet, seed: int) -> str | None:
    """What the poses seem to be, in words, when the views then agree far better; None where nothing helps."""
    some = np.unique(np.linspace(0, len(views) - 1, min(len(views), _VIEWS)).astype(np.intp))
    as_read, C = views.base_from_flange[some], views.camera_from_board[some]
    limit = _spread(mount_poses(as_read, views.mount), C, seed) / _MUCH_BETTER
    tried = {
        words: _spread(mount_poses(change(as_read), views.mount), C, seed)
        for words, change in _CONVENTIONS.items()
    }
    best, second = sorted(tried, key=tried.__getitem__)[:2]
    return best if tried[best] < min(limit, tried[second] / _CLEAR) else None


def _spread(H: Array, C: Array, seed: int) -> float:
    """Median distance times median angle of the board's places from the most central one, m rad.

    Of the better of two X: from all pairs, and by a loss that saturates; each again from the half of the
    views that agrees best with it.
    """
    pairs = all_pairs(H, C)
    found = []
    for X in (solve_global(pairs, seed).X, solve_geman_mcclure(pairs, seed)):
        apart, near = _apart(board_places(H, C, X))
        found += [apart, _apart(board_places(H, C, solve_global(all_pairs(H[near], C[near]), seed).X))[0]]
    return min(found)


def _apart(places: Array) -> tuple[float, Places]:
    """The spread of `_spread`, and the half of the views that is nearest to the most central one."""
    delta = difference(places[:, None], places[None])
    metres, radians = (np.linalg.norm(part, axis=2) for part in (delta[..., :3], delta[..., 3:]))
    spread = np.median(metres, axis=1) * np.median(radians, axis=1)
    centre = int(spread.argmin())
    order = np.argsort(metres[centre] * radians[centre], kind="stable")
    return float(spread[centre]), np.sort(order[: max(4, len(order) // 2)])


def _turned(change: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Of rotations (n, 3, 3), for poses (n, 4, 4)."""

    def changed(poses: Array) -> Array:
        result = poses.copy()
        result[:, :3, :3] = change(poses[:, :3, :3])
        return result

    return changed


def _w_first(R: Array) -> Array:
    return matrix_from_quaternion(np.roll(quaternion_from_matrix(R), -1, axis=-1))


def _vectors(R: Array) -> Array:
    """Of the two triples of angles that make R, the one that can be a rotation vector (at most 180° long)."""
    angles = Rotation.from_matrix(R).as_euler("xyz")
    other = np.stack([angles[:, 0] + np.pi, np.pi - angles[:, 1], angles[:, 2] + np.pi], axis=1)
    other = (other + np.pi) % (2 * np.pi) - np.pi
    shorter = np.linalg.norm(angles, axis=1) <= np.linalg.norm(other, axis=1)
    return rotation_exp(np.where(shorter[:, None], angles, other))


def _angles(R: Array) -> Array:
    return np.asarray(Rotation.from_euler("xyz", rotation_log(R)).as_matrix())


_CONVENTIONS: dict[str, Callable[[Array], Array]] = {
    "flange_from_base in place of base_from_flange, or of a cell with the other mount": inverse,
    "quaternions in the order w, x, y, z in place of x, y, z, w": _turned(_w_first),
    "rotation vectors that were read as roll, pitch, yaw": _turned(_vectors),
    "roll, pitch, yaw that were read as rotation vectors": _turned(_angles),
    "inverse rotations beside right positions": _turned(lambda R: np.asarray(R.transpose(0, 2, 1))),
}
