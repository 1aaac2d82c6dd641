"""Candidate poses: views in which the board is seen well and that the arm can reach without collision."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibrate.arms.kinematics import inverse_many, singularity_measure
from recordings.geometry import Array
from station.cell.collision import Contact, margins
from station.cell.layout import CellLayout
from station.cell.limits import joint_bounds
from station.plan.order import move_times
from station.plan.visibility import ViewRange, camera_views, seen_for_certain, sees_past_the_arm

# Names of limits, as people read them.
NOT_IN_PICTURE = "the whole board is not in the image"
OUT_OF_REACH = "the arm's reach"
ARM_IN_SIGHT = "the arm itself, between camera and board"
_PATH_RESERVE_M = 0.01
"""Clearance of poses beyond every limit, so that moves between neighbours have room."""
_HUBS = 6
"""Postures tried as hub of a group: it holds what the arm reaches from there by a free direct move."""
_NEARLY_ALL = 0.85
"""Share of the branch that a group must hold for the search of a better hub to end."""
_REACH_RAD = 2.6
"""Largest turn of a joint between hub and member of a group, to avoid wrist flips and wound-up cables."""


@dataclass(frozen=True, eq=False)
class CandidateSet:
    """Candidates that passed all checks; a pose may appear once per arm branch."""

    joints_rad: Array
    """(n, 6)"""
    base_from_flange: Array
    """(n, 4, 4)"""
    branch: NDArray[np.intp]
    """(n,) arm branch, as numbered by `inverse_many`"""
    lost: Counter[str] = field(default_factory=Counter)
    """Limit → number of rejected poses that violate it (a pose may violate several)."""
    alone: Counter[str] = field(default_factory=Counter)
    """Limit → number of rejected poses that violate only it."""

    def __len__(self) -> int:
        return len(self.joints_rad)

    def take(self, places: NDArray[np.intp]) -> CandidateSet:
        return replace(
            self,
            joints_rad=self.joints_rad[places],
            base_from_flange=self.base_from_flange[places],
            branch=self.branch[places],
        )


def find_candidates(
    layout: CellLayout,
    view: ViewRange,
    count: int,
    rng: np.random.Generator,
    near_joints_rad: Array | None,
    tries: int | None = None,
) -> CandidateSet:
    """Draw views and find the postures, of all arm branches, that pass all checks.

    `tries` (None: `count`) views are drawn; the first `count` that certainly show the board are used.
    """
    views = camera_views(layout.camera, layout.board, view, tries or count, rng)
    flange = layout.base_from_flange(views)
    seen = seen_for_certain(layout, flange, view)
    lost = Counter({NOT_IN_PICTURE: int((~seen).sum())})
    flange = flange[seen][:count]
    rows, joints, branches = _all_branches(layout, flange, near_joints_rad)
    lost[OUT_OF_REACH] = len(flange) - len(np.unique(rows))
    checks = _checks(layout, view, joints, flange[rows])
    keep = np.logical_and.reduce(list(checks.values()))
    failing = np.sum([~good for good in checks.values()], axis=0)
    alone = Counter({name: int((~good & (failing == 1)).sum()) for name, good in checks.items()})
    lost += Counter({name: int((~good).sum()) for name, good in checks.items()})
    kept = CandidateSet(joints, flange[rows], branches, lost, alone)
    return kept.take(np.flatnonzero(keep))


def _checks(
    layout: CellLayout, view: ViewRange, joints: Array, base_from_flange: Array
) -> dict[str, NDArray[np.bool_]]:
    """Check joints (n, 6): return results (n,) by name of the limit."""
    low, high = joint_bounds(layout.geometry)
    checks: dict[str, NDArray[np.bool_]] = {
        "the joint range": np.asarray(((joints >= low) & (joints <= high)).all(axis=1)),
        "singular postures": np.asarray(
            singularity_measure(layout.geometry.model, joints) >= view.smallest_singular
        ),
        ARM_IN_SIGHT: sees_past_the_arm(layout, joints, base_from_flange),
    }
    gaps, contacts = margins(layout.geometry, joints)
    for contact, gap in zip(contacts, gaps.T, strict=True):
        name = _limit_of(contact)
        good = np.asarray(gap >= _PATH_RESERVE_M)
        checks[name] = checks[name] & good if name in checks else good
    return checks


def _limit_of(contact: Contact) -> str:
    """Name the limit of a contact; all contacts of the arm with itself are one."""
    if contact.kind == "workspace":
        return "the workspace box"
    if contact.kind == "self":
        return "the arm touching itself or its tool"
    return "the " + contact.other.removeprefix("the ")


def _all_branches(
    layout: CellLayout, flange: Array, near: Array | None
) -> tuple[NDArray[np.intp], Array, NDArray[np.intp]]:
    """Compute inverse kinematics: row in `flange` (m,), joints (m, 6), and arm branch (m,)."""
    low, high = joint_bounds(layout.geometry)
    rows, q, branches = inverse_many(layout.geometry.model, flange)
    for branch in np.unique(branches):
        here = branches == branch
        q[here] = _gather(q[here], near, low, high)
    return rows, q, branches


def _gather(q: Array, near: Array | None, low: Array, high: Array) -> Array:
    """Add full turns to joints (n, 6) so that they lie together, near the start, within low…high (6,)."""
    turn = 2 * np.pi
    mean = np.angle(np.exp(1j * q).mean(axis=0))
    mean += turn * np.round(((near if near is not None else (low + high) / 2) - mean) / turn)
    q = mean + (q - mean + np.pi) % turn - np.pi
    q = np.where(q < low, q + turn, q)
    return np.where(q > high, q - turn, q)


def best_group(
    layout: CellLayout, found: CandidateSet, start: Array | None, wanted: int, plenty: int
) -> CandidateSet:
    """Choose at most `wanted` candidates of one arm branch with free direct moves to a common hub.

    The branch is the nearest to the start with at least `plenty` candidates, else the largest. With a start,
    it must have a free direct move into the group. Empty when there is none.
    """
    branches = [found.take(np.flatnonzero(found.branch == n)) for n in np.unique(found.branch)]
    if start is None:
        branches.sort(key=lambda branch: -len(branch))
    else:
        branches.sort(key=lambda branch: float(np.abs(branch.joints_rad - start).max(axis=1).min()))
    best = found.take(np.zeros(0, dtype=int))
    for branch in branches:
        group = _best_of_branch(layout, branch.take(np.arange(min(wanted, len(branch)))), start)
        if len(group) > len(best):
            best = group
        if len(best) >= plenty:
            break
    return best


def _best_of_branch(layout: CellLayout, branch: CandidateSet, start: Array | None) -> CandidateSet:
    groups = [branch.take(np.zeros(0, dtype=int))]
    for hub in _hubs(branch.joints_rad, start):
        free = np.isfinite(_moves(layout, hub, branch.joints_rad))
        group = branch.take(np.flatnonzero(free))
        if start is None or np.isfinite(_moves(layout, start, group.joints_rad, reach_rad=np.inf)).any():
            groups.append(group)
        if len(groups[-1]) >= _NEARLY_ALL * len(branch):
            break
    return max(groups, key=len)


def _hubs(joints: Array, start: Array | None) -> Iterator[Array]:
    """Yield hubs to try: the start, the member nearest to the middle, then members far from these."""
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


def _moves(layout: CellLayout, hub: Array, members: Array, reach_rad: float = _REACH_RAD) -> Array:
    """Compute durations (n,) of direct moves from hub to members; infinite where too far or not free."""
    near = np.abs(members - hub).max(axis=1) <= reach_rad
    times = np.full(len(members), np.inf)
    times[near] = move_times(layout.geometry, np.repeat(hub[None], int(near.sum()), axis=0), members[near])
    return times
