"""Order of the poses: short in time, every move free of collision."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from recordings.geometry import Array
from station.cell.collision import SPACING_M, CellGeometry, margins, moving_points, surface_speeds
from station.cell.limits import leading_speed, leaving, trapezoid

_SAMPLES = (9, 33, 129)
"""Numbers of samples along a move, tried in this order until the result is certain."""
BLOCKED = np.inf
"""Duration of a move that violates a limit."""
_NEAR_STARTS, _OTHER_STARTS = 8, 4
"""Tours that begin near the arm, and elsewhere: each is improved, and the shortest counts."""
_LONG_TOUR = 60
"""Number of poses above which no single pieces of a tour are moved, as there are too many ways."""


def move_times(geometry: CellGeometry, joints_from: Array, joints_to: Array) -> Array:
    """Compute durations (n,), s, of joint moves (n, 6) → (n, 6); BLOCKED where the path violates a limit.

    Conservative: half of the motion of modelled points between samples is taken off the margins. Moves that
    few samples cannot decide are sampled more densely.
    """
    times = np.full(len(joints_from), BLOCKED)
    open_moves = np.flatnonzero(
        np.abs(joints_to - joints_from).max(axis=1, initial=0.0) <= geometry.limits.joint_step_rad
    )
    for samples in _SAMPLES:
        if len(open_moves) == 0:
            break
        seconds, free, hopeless = _sampled(geometry, joints_from[open_moves], joints_to[open_moves], samples)
        times[open_moves[free]] = seconds[free]
        open_moves = open_moves[~free & ~hopeless]
    return times


def _sampled(
    geometry: CellGeometry, joints_from: Array, joints_to: Array, samples: int
) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Compute durations (n,) of moves, and masks of the certainly free and the certainly blocked ones."""
    n = len(joints_from)
    paths = joints_from[:, None] + np.linspace(0, 1, samples)[:, None] * (joints_to - joints_from)[:, None]
    flat = paths.reshape(-1, 6)
    points = moving_points(geometry, flat).reshape(n, samples, -1, 3)
    travel = np.linalg.norm(np.diff(points, axis=1), axis=-1).max(axis=(1, 2))
    gaps = margins(geometry, flat)[0].reshape(n, samples, -1)
    slack = np.maximum(1.1 * travel, SPACING_M) / 2
    free = leaving(gaps - slack[:, None, None]).min(axis=(1, 2)) >= 0
    hopeless = leaving(gaps - SPACING_M / 2).min(axis=(1, 2)) < 0
    step = np.abs(joints_to - joints_from).max(axis=1)
    per_rad = np.repeat((joints_to - joints_from) / np.maximum(step, 1e-9)[:, None], samples, axis=0)
    rate = surface_speeds(geometry, flat, per_rad).reshape(n, -1).max(axis=1)
    duration, _ = trapezoid(step, *leading_speed(geometry.limits, rate))
    return duration, np.asarray(free), np.asarray(hopeless)


def ordered(
    geometry: CellGeometry, joints: Array, start: Array | None, seed: int
) -> tuple[list[int], list[int]]:
    """Find a short order of joints (n, 6). The second list holds the indices of poses without a free path."""
    times, lead = time_matrix(geometry, joints), np.zeros(len(joints))
    if start is not None:
        lead = move_times(geometry, np.repeat(start[None], len(joints), axis=0), joints)
    order = short_order(times, lead, seed)
    if lead[order[0]] == BLOCKED:
        return order, [order[0]]
    free = np.isfinite(times).sum(axis=1)
    return order, [min(legs, key=lambda m: free[m]) for legs in pairwise(order) if times[legs] == BLOCKED]


def time_matrix(geometry: CellGeometry, joints_rad: Array) -> Array:
    """Compute durations (n, n) of moves between all poses, symmetric, BLOCKED where not free."""
    n = len(joints_rad)
    i, j = np.triu_indices(n, 1)
    times = np.zeros((n, n))
    times[i, j] = times[j, i] = move_times(geometry, joints_rad[i], joints_rad[j])
    return times


def short_order(times: Array, first_leg: Array, seed: int) -> list[int]:
    """Find a short open path through all n poses; `first_leg` (n,): time from the start to each.

    Nearest neighbour from every pose, then 2-opt and or-opt until nothing improves. BLOCKED moves are avoided
    where possible; `path_time` tells whether one is left.
    """
    n = len(times)
    cost = np.where(np.isfinite(times), times, 1e4)
    lead = np.where(np.isfinite(first_leg), first_leg, 1e4)
    patterns = _patterns(n)
    rng = np.random.default_rng(seed)
    starts = [*np.argsort(lead, kind="stable")[:_NEAR_STARTS], *rng.permutation(n)[:_OTHER_STARTS]]
    tours = [_improve(_nearest(cost, int(s)), cost, lead, patterns) for s in dict.fromkeys(starts)]
    return min(tours, key=lambda tour: path_time(tour, cost, lead))


def path_time(order: list[int], times: Array, first_leg: Array) -> float:
    return float(first_leg[order[0]] + sum(times[a, b] for a, b in pairwise(order)))


def _nearest(cost: Array, start: int) -> list[int]:
    left, tour = set(range(len(cost))) - {start}, [start]
    while left:
        tour.append(min(left, key=lambda j: (cost[tour[-1], j], j)))
        left.remove(tour[-1])
    return tour


def _improve(tour: list[int], cost: Array, lead: Array, patterns: NDArray[np.intp]) -> list[int]:
    """Improve a tour by the best rearrangement until none makes it shorter."""
    now = np.array(tour)
    best = path_time(tour, cost, lead)
    while True:
        tours = now[patterns]
        lengths = lead[tours[:, 0]] + cost[tours[:, :-1], tours[:, 1:]].sum(axis=1)
        shortest = int(np.argmin(lengths))
        if lengths[shortest] >= best - 1e-9:
            return [int(place) for place in now]
        now, best = tours[shortest], float(lengths[shortest])


@lru_cache(maxsize=4)
def _patterns(n: int) -> NDArray[np.intp]:
    """List rearrangements (m, n): every stretch reversed; for short tours also every short piece moved."""
    places = list(range(n))
    found = [places[:i] + places[i : j + 1][::-1] + places[j + 1 :] for i in places for j in range(i + 1, n)]
    for size in (1, 2, 3) if n <= _LONG_TOUR else ():
        for i in range(n - size + 1):
            piece, rest = places[i : i + size], places[:i] + places[i + size :]
            found += [rest[:k] + piece + rest[k:] for k in range(len(rest) + 1) if k != i]
    return np.array(found or [places])
