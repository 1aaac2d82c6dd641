"""Candidates that belong together: one arm branch, and a free direct move from a common hub to each."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calibrate.geometry import Array
from station.cell.scene import Scene
from station.plan.candidates import Pool
from station.plan.order import move_times

_HUBS = 6
_NEARLY_ALL = 0.85
"""Of the branch: no other hub needs to be looked at."""
_REACH_RAD = 2.6
"""Members turn no joint further than this from the hub: no flips of the wrist, no wound-up cables."""


def best_group(scene: Scene, found: Pool, start: Array | None, wanted: int, plenty: int) -> Pool:
    """A group of at most `wanted`: of the branch nearest to the start that has `plenty`, or else the largest.

    With a start, only groups count that it has a free direct move into. Empty when there is none.
    """
    branches = [found.take(np.flatnonzero(found.branch == n)) for n in np.unique(found.branch)]
    if start is None:
        branches.sort(key=lambda branch: -len(branch))
    else:
        branches.sort(key=lambda branch: float(np.abs(branch.joints_rad - start).max(axis=1).min()))
    best = found.take(np.zeros(0, dtype=int))
    for branch in branches:
        group = _best_of_branch(scene, branch.take(np.arange(min(wanted, len(branch)))), start)
        if len(group) > len(best):
            best = group
        if len(best) >= plenty:
            break
    return best


def _best_of_branch(scene: Scene, branch: Pool, start: Array | None) -> Pool:
    groups = [branch.take(np.zeros(0, dtype=int))]
    for hub in _hubs(branch.joints_rad, start):
        free = np.isfinite(_moves(scene, hub, branch.joints_rad))
        group = branch.take(np.flatnonzero(free))
        if start is None or np.isfinite(_moves(scene, start, group.joints_rad, reach_rad=np.inf)).any():
            groups.append(group)
        if len(groups[-1]) >= _NEARLY_ALL * len(branch):
            break
    return max(groups, key=len)


def _hubs(joints: Array, start: Array | None) -> Iterator[Array]:
    """The start, the member nearest to the middle, then members far from these (farthest-point sampling)."""
    if start is not None:
        yield start
    if len(joints) == 0:
        return
    hub = int(np.abs(joints - np.median(joints, axis=0)).max(axis=1).argmin())
    away = np.full(len(joints), np.inf)
    for _ in range(min(_HUBS, len(joints))):
        yield joints[hub]
        away = np.minimum(away, np.abs(joints - joints[hub]).max(axis=1))
        hub = int(away.argmax())


def _moves(scene: Scene, hub: Array, members: Array, reach_rad: float = _REACH_RAD) -> Array:
    """Durations (n,) of direct moves hub → members; infinite beyond the reach or where not free."""
    near = np.abs(members - hub).max(axis=1) <= reach_rad
    times = np.full(len(members), np.inf)
    times[near] = move_times(scene.geometry, np.repeat(hub[None], int(near.sum()), axis=0), members[near])
    return times
