"""Which views contradict X, and why: every rejected view is named with its reason.

A view is judged by the distance between its recorded flange pose and the one that X, the board's place and
its own corners imply, in sigmas of both together (corners and robot).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from calibrate.board_poses import BoardPoses
from calibrate.estimate import Estimate
from calibrate.geometry import Array, difference, inverse, pose, rotation_exp, transform_points
from calibrate.likelihood.model import Observations, State
from calibrate.likelihood.residuals import modelled_flange, robot_derivatives, robot_residuals
from calibrate.mixture import LinearMisses
from calibrate.pairs import Places, mount_poses
from calibrate.solution import RejectedView
from calibrate.views import ImageView, ViewSet
from calibrate.wrong_number import tell_wrong_number, wrong_numbers

_FALSE_ALARM = 5e-4
"""Probability that a good view is rejected (more with few views, by the limit below)."""
_LARGEST_SIGMAS = 6.0
"""No view that is farther out than this is kept, however few there are."""
_BLURRED = 5.0
"""A view whose typical corner error is this many times the others' is not trusted."""
_BLURRED_PX = 0.5
_OTHER_SIZE = 0.02
"""A board that seems larger or smaller by less than this is not taken for one of another size."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """All views against one X."""

    distance2: Array
    """(n,) squared sigmas, 6 degrees of freedom."""
    linear: LinearMisses
    covariance: Array
    """(n, 6, 6) of the misses, were all views good."""
    modelled: Array
    """(n, 4, 4)"""
    freedom: float
    """Of the noise scales: `distance2` / 6 of good views follows F(6, freedom)."""
    blurred: NDArray[np.bool_]
    """(n,)"""

    @property
    def miss(self) -> Array:
        """(n, 6) modelled against recorded flange."""
        return self.linear.miss

    @property
    def limit(self) -> float:
        """Of `distance2`."""
        chance = float(6 * stats.f.ppf(1 - _FALSE_ALARM, 6, self.freedom))
        return min(chance, _LARGEST_SIGMAS**2)

    @property
    def good(self) -> Places:
        return np.flatnonzero((self.distance2 <= self.limit) & ~self.blurred)


def judge_views(observed: Observations, result: Estimate, boards: BoardPoses, fitted: Places) -> Judgement:
    """`observed` and `boards` speak of all views, `result` rests on the `fitted` ones.

    For the others the uncertainty of X, Y and the kinematic errors counts too.
    """
    state = replace(result.state, C=boards.C)
    linear = _linear_misses(observed, state, result, boards)
    covariance = linear.covariance(linear.sigma)
    others = np.setdiff1d(np.arange(len(covariance)), fitted)
    J = linear.by_global[others]
    covariance[others] += J @ result.joint_covariance @ np.swapaxes(J, 1, 2)
    miss = linear.miss
    distance2 = np.einsum("ni,ni->n", miss, np.linalg.solve(covariance, miss[..., None])[..., 0])
    # Two scales, each from 3N - 6 residuals: simulated, the tail is that of F with half as many again.
    freedom = 1.5 * max(3 * len(fitted) - 6, 3)
    typical = float(np.median(boards.typical_px))
    blurred = boards.typical_px > max(_BLURRED * typical, _BLURRED_PX)
    return Judgement(distance2, linear, covariance, modelled_flange(observed, state), freedom, blurred)


def _linear_misses(
    observed: Observations, state: State, result: Estimate, boards: BoardPoses
) -> LinearMisses:
    by_X, by_Y, by_C = robot_derivatives(observed, state)
    parts = [by_X, by_Y] if observed.kinematics is None else [by_X, by_Y, -observed.kinematics]
    prior = np.concatenate([np.zeros(12), np.full(len(state.theta), result.sigma[3] ** -2)])
    return LinearMisses(
        miss=robot_residuals(observed, state),
        by_global=np.concatenate(parts, axis=2),
        by_corners=result.sigma[0] ** 2 * by_C @ boards.covariance @ np.swapaxes(by_C, 1, 2),
        prior=prior,
        pull=prior * np.concatenate([np.zeros(12), state.theta]),
        sigma=result.sigma[1:3],
    )


def board_turns(view: ImageView) -> list[Array]:
    """Rigid maps of the board onto itself: half a turn, and quarter turns where it is square."""
    if not len(view.board_points):
        return []
    low, high = view.board_points.min(axis=0), view.board_points.max(axis=0)
    centre = (low + high) / 2
    square = abs((high - low)[0] - (high - low)[1]) < 1e-9
    turns = []
    for quarter in (2, 1, 3) if square else (2,):
        R = rotation_exp([0.0, 0.0, quarter * np.pi / 2])
        turns.append(pose(R, centre - R @ centre))
    return turns


def turn_view(view: ImageView, turn: Array) -> ImageView:
    """The same picture with its corners read in turned order."""
    assert view.camera_from_board is not None
    return replace(
        view,
        board_points=transform_points(turn, view.board_points),
        camera_from_board=view.camera_from_board @ inverse(turn),
    )


def explain(views: ViewSet, state: State, verdict: Judgement, places: Places) -> tuple[RejectedView, ...]:
    """Name and reason for each rejected place."""
    moved = _moved_boards(views, state, verdict, places)
    found = [_explain_one(views, state, verdict, int(i), moved) for i in places]
    unclear = [n for n, view in enumerate(found) if view.kind == "inconsistent"]
    at = places[unclear]
    for n, number in wrong_numbers(verdict.miss[at], verdict.covariance[at], verdict.freedom).items():
        reason = tell_wrong_number(verdict.miss[at[n]], number)
        found[unclear[n]] = replace(
            found[unclear[n]], reason=reason, kind="wrong-number", wrong_number=number
        )
    return tuple(found)


def _explain_one(
    views: ViewSet, state: State, verdict: Judgement, i: int, moved: dict[int, str]
) -> RejectedView:
    view = views.views[i]
    miss_mm, miss_deg = _size(verdict.miss[i])
    gap = f"robot and picture disagree by {miss_mm:.2f} mm and {miss_deg:.3f}°"
    if verdict.blurred[i]:
        reason = "its corners fit no board pose: blurred, hidden or misread"
        return RejectedView(view.index, view.name, reason, "corners")
    other = _owner_of_pose(views, verdict, i)
    if other is not None:
        reason = f"wrong pose: it carries the robot pose of view {views.views[other].index + 1} ({gap})"
        return RejectedView(view.index, view.name, reason, "wrong-pose")
    if i in moved:
        return RejectedView(view.index, view.name, f"{moved[i]} ({gap})", "moved-board")
    scale = _fitting_scale(views, state, i, verdict)
    if scale is not None:
        reason = f"wrong square size: with squares {scale:.3f} times as large it would agree ({gap})"
        return RejectedView(view.index, view.name, reason, "wrong-square-size")
    return RejectedView(view.index, view.name, f"{gap}: wrong pose, or the board was moved", "inconsistent")


def _size(miss: Array) -> tuple[float, float]:
    return float(np.linalg.norm(miss[:3])) * 1e3, float(np.degrees(np.linalg.norm(miss[3:])))


def _tolerance(verdict: Judgement) -> Array:
    """(2,) m and rad within which two poses pass for the same: 5 typical misses of the good views."""
    good = verdict.good
    misses = verdict.miss[good] if len(good) else verdict.miss
    lengths = [np.linalg.norm(misses[:, :3], axis=1), np.linalg.norm(misses[:, 3:], axis=1)]
    return np.array([max(5 * float(np.median(v)), 1e-6) for v in lengths])


def _near(poses: Array, other: Array, tolerance: Array) -> NDArray[np.bool_]:
    delta = difference(poses, other)
    lengths = np.stack([np.linalg.norm(delta[..., :3], axis=-1), np.linalg.norm(delta[..., 3:], axis=-1)], -1)
    return np.asarray((lengths < tolerance).all(axis=-1))


def _owner_of_pose(views: ViewSet, verdict: Judgement, i: int) -> int | None:
    """Whose modelled flange pose is the one recorded for view i?"""
    recorded = np.asarray(views.views[i].base_from_flange)
    near = _near(verdict.modelled, recorded, _tolerance(verdict))
    near[i] = False
    found = np.flatnonzero(near)
    return int(found[0]) if len(found) else None


def _board_places(views: ViewSet, state: State) -> Array:
    return np.asarray(mount_poses(views.base_from_flange, views.mount) @ state.X @ state.C)


def _moved_boards(views: ViewSet, state: State, verdict: Judgement, places: Places) -> dict[int, str]:
    """Rejected views that agree with each other on another place of the board."""
    where = _board_places(views, state)
    tolerance = _tolerance(verdict)
    found: dict[int, str] = {}
    for i in places:
        if _near(where[i], state.Y, 2 * tolerance):
            continue  # as small as this, any errors agree with each other
        near = _near(where[places], where[i], tolerance)
        if near.sum() >= 2:
            shift_mm, turn_deg = _size(difference(where[i], state.Y))
            numbers = ", ".join(str(views.views[int(j)].index + 1) for j in places[near])
            found[int(i)] = (
                f"moved board: views {numbers} agree on a place {shift_mm:.1f} mm and {turn_deg:.2f}° away"
            )
    return found


def _fitting_scale(views: ViewSet, state: State, i: int, verdict: Judgement) -> float | None:
    """Factor on the board's size that brings the view to the board's place; None if none does."""
    H = mount_poses(views.base_from_flange[i : i + 1], views.mount)[0]
    camera_in_place = H @ state.X
    ray = camera_in_place[:3, :3] @ state.C[i, :3, 3]
    target = state.Y[:3, 3] - camera_in_place[:3, 3]
    scale = float(ray @ target / (ray @ ray))
    tolerance = _tolerance(verdict)
    left = np.linalg.norm(scale * ray - target)
    turn = np.linalg.norm(verdict.miss[i, 3:])
    return scale if left < tolerance[0] and turn < tolerance[1] and abs(scale - 1) > _OTHER_SIZE else None
