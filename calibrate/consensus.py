"""From views of which some may be wrong to the group that agrees, turned boards set right, a certified X."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.assess import board_places, mean_pose, require_motion
from calibrate.errors import BadViewsError, PosesDisagreeError
from calibrate.evolution_robust import solve_geman_mcclure
from calibrate.geometry import Array, difference
from calibrate.outliers import board_turns, turn_view
from calibrate.pairs import Pairs, Places, all_pairs, mount_poses
from calibrate.robust import GlobalResult, solve_global
from calibrate.screening import detect_shift, screen
from calibrate.views import ImageView, ViewSet

_ENOUGH = 0.55
"""Share of views in one agreeing group above which the screening needs no second opinion."""
_NEAR = 4.0
"""Medians of the group's own misses within which a view belongs to it (6 sigmas of a Maxwell spread)."""
_ROUNDS = 5
_FEWEST = 4


@dataclass(frozen=True, eq=False)
class Consensus:
    views: ViewSet
    """All views, turned boards set right."""
    places: Places
    """Those that agree."""
    turned: frozenset[int]
    """Places of the views set right."""
    start: GlobalResult


def find_consensus(views: ViewSet, seed: int, reject: bool = True) -> Consensus:
    """Raises BadViewsError for poses shifted against pictures, or where no four views agree.

    reject False: every view is taken as it is.
    """
    H, C = pose_arrays(views)
    if not reject:
        pairs = all_pairs(H, C)
        require_motion(pairs)
        return Consensus(views, np.arange(len(H)), frozenset(), _solve(pairs, seed, len(H)))
    _require_no_shift(views, H, C)
    places = _first_group(H, C, seed)
    turned: frozenset[int] = frozenset()
    for _ in range(_ROUNDS):
        if len(places) < _FEWEST:
            raise PosesDisagreeError(f"No {_FEWEST} of the {len(views)} views agree with each other.")
        pairs = _pairs_of(H, C, places)
        require_motion(pairs)
        start = _solve(pairs, seed, len(places))
        views, newly = _set_right(views, start.X, places)
        turned = turned ^ newly
        H, C = pose_arrays(views)
        agreeing = _near(H, C, start.X, places)
        if np.array_equal(agreeing, places):
            break
        places = agreeing if len(agreeing) >= _FEWEST else places
    return Consensus(views, places, turned, start)


def pose_arrays(views: ViewSet) -> tuple[Array, Array]:
    """H (n, 4, 4) as in `pairs` and camera_from_board (n, 4, 4)."""
    return mount_poses(views.base_from_flange, views.mount), views.camera_from_board


def _solve(pairs: Pairs, seed: int, views: int) -> GlobalResult:
    return solve_global(pairs, seed, f"chordal objective over {len(pairs)} pairs of {views} agreeing views")


def _require_no_shift(views: ViewSet, H: Array, C: Array) -> None:
    shift = detect_shift(H, C)
    if shift:
        i = max(0, -shift)
        here, there = views.views[i], views.views[i + shift]
        raise BadViewsError(
            f"Pictures and robot poses are shifted by {abs(shift)}: the picture of view {here.index + 1} "
            f"({here.name}) fits the robot pose of view {there.index + 1} ({there.name}), and so on "
            "through the session. Move the poses by that many rows (poses.csv) and import again."
        )


def _first_group(H: Array, C: Array, seed: int) -> Places:
    """By the screening; by evolution with a saturating loss as well where the screening is in doubt."""
    screening = screen(H, C)
    if screening.share >= _ENOUGH:
        return screening.group
    voters = screening.voters
    X = solve_geman_mcclure(all_pairs(H[voters], C[voters]), seed)
    places = _near(H, C, X, voters)
    return places if len(places) > len(screening.group) else screening.group


def _pairs_of(H: Array, C: Array, places: Places) -> Pairs:
    pairs = all_pairs(H[places], C[places])
    return Pairs(pairs.A, pairs.B, places[pairs.first], places[pairs.second])


def _misses(H: Array, C: Array, X: Array, Y: Array) -> Array:
    """(n, 2) how far each view puts the board from Y: metres, radians."""
    delta = difference(board_places(H, C, X), Y)
    return np.stack([np.linalg.norm(delta[:, :3], axis=1), np.linalg.norm(delta[:, 3:], axis=1)], axis=1)


def _middle(H: Array, C: Array, X: Array, places: Places) -> tuple[Array, Array]:
    """Place of the board (4, 4) by the group, far members left out, and the tolerance (2,) around it."""
    wheres = board_places(H[places], C[places], X)
    centre = np.median(wheres[:, :3, 3], axis=0)
    Y = mean_pose(wheres)
    Y[:3, 3] = centre
    for _ in range(3):
        misses = _misses(H[places], C[places], X, Y)
        tolerance = np.maximum(_NEAR * np.median(misses, axis=0), 1e-6)
        inside = (misses <= tolerance).all(axis=1)
        if inside.sum() < _FEWEST:
            break
        Y = mean_pose(wheres[inside])
    return Y, tolerance


def _near(H: Array, C: Array, X: Array, places: Places) -> Places:
    """All views that put the board where the group does."""
    Y, tolerance = _middle(H, C, X, places)
    return np.flatnonzero((_misses(H, C, X, Y) <= tolerance).all(axis=1))


def _set_right(views: ViewSet, X: Array, places: Places) -> tuple[ViewSet, frozenset[int]]:
    """Turn the boards of far views where that brings them to the group's place."""
    H, C = pose_arrays(views)
    Y, tolerance = _middle(H, C, X, places)
    far = np.flatnonzero((_misses(H, C, X, Y) > tolerance).any(axis=1))
    changed: dict[int, ImageView] = {}
    for i in far.tolist():
        for turn in board_turns(views.views[i]):
            trial = turn_view(views.views[i], turn)
            pose = np.asarray(trial.camera_from_board)[None]
            if (_misses(H[i : i + 1], pose, X, Y) <= tolerance).all():
                changed[i] = trial
                break
    if not changed:
        return views, frozenset()
    kept = tuple(changed.get(i, view) for i, view in enumerate(views))
    return replace(views, views=kept), frozenset(changed)
