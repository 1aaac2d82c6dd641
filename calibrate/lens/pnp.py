"""Board poses from images: every pose that one image cannot tell apart, and the choice by the robot's motion.

For the right readings of two views the robot's and the board's relative motions A and B are the same screw:
equal angles, equal translations along the axis, whatever X is. So every pair of readings is scored without X.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.model import board_from_turned, looks_same_turns
from calibrate.errors import BadViewsError
from calibrate.handeye.axxb.pairs import screw_invariants
from calibrate.handeye.corner_fit import fit_corners
from calibrate.views.projection import camera_matrix, project_at, undistort
from calibrate.views.view_set import BoardView, ViewSet, observe_views
from recordings.geometry import Array, inverse, pose, rotation_exp, transform_points
from recordings.schema.messages import BoardSpec, CameraModel, Mount


@dataclass(frozen=True, eq=False)
class Candidate:
    """One reading of an image."""

    camera_from_board: Array
    turn: int
    """Quarters by which the board's frame is turned against the detected order."""


def solve_pnp(views: ViewSet, board: BoardSpec | None = None) -> ViewSet:
    """Add `camera_from_board` to the views, points relabelled where a turned reading fits better.

    Two things are ambiguous in one image: which way round a symmetric board lies (only when `board` is
    given) and, for a small board far away, towards which side it is tilted. All views together decide, by
    their agreement with the robot's motion. Raises BadViewsError when a view has no pose at all.
    """
    return with_poses(views, _candidates(views, board), board)


def with_poses(views: ViewSet, candidates: list[list[Candidate]], board: BoardSpec | None) -> ViewSet:
    """Keep of each view's candidates the one that agrees with the robot's motion, and relabel its points."""
    if all(len(c) == 1 for c in candidates):
        chosen = [0] * len(candidates)
    else:
        chosen = choose_candidates(
            [np.array([c.camera_from_board for c in each]) for each in candidates],
            views.base_from_flange,
            views.mount,
        )
    solved = []
    for view, options, k in zip(views, candidates, chosen, strict=True):
        corners = view.corners
        if board is not None and options[k].turn:
            turned = inverse(board_from_turned(board, options[k].turn))
            corners = replace(corners, points=transform_points(turned, corners.points))
        solved.append(replace(view, camera_from_board=options[k].camera_from_board, corners=corners))
    return replace(views, views=tuple(solved))


def candidate_poses(view: BoardView, camera: CameraModel, board: BoardSpec | None) -> list[Candidate]:
    """List poses that explain the image equally well, best first, in every turn that looks the same."""
    return _candidates(ViewSet("eye-in-hand", (view,), camera), board)[0]


def _candidates(views: ViewSet, board: BoardSpec | None) -> list[list[Candidate]]:
    turned = [(0, np.eye(4))]
    if board is not None:
        turned = [(turn, board_from_turned(board, turn)) for turn in looks_same_turns(board)]
    return [
        [Candidate(tilt @ matrix, turn) for turn, matrix in turned for tilt in tilts]
        for tilts in _planar_poses(views)
    ]


def _planar_poses(views: ViewSet) -> list[list[Array]]:
    """T. Collins, A. Bartoli: "Infinitesimal plane-based pose estimation" (2014), then least squares."""
    starts = [planar_tilts(view, views.camera) for view in views]
    owner = np.repeat(np.arange(len(views)), [len(each) for each in starts])
    found = fit_corners(observe_views(views).part(owner), views.camera, np.concatenate(starts))
    poses, rms_px = found.C, found.rms_px
    in_front = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(rms_px) & (poses[:, 2, 3] > 0)
    candidates = []
    for i, view in enumerate(views):
        own = np.flatnonzero(in_front & (owner == i))
        if not len(own):
            raise BadViewsError(
                "no-board-pose", view=view.index + 1, name=view.name, reason="none lies before the camera"
            )
        own = own[np.argsort(rms_px[own], kind="stable")]
        limit_px = _credible_px(rms_px[own[0]])
        candidates.append([poses[k] for k in own if rms_px[k] <= limit_px])
    return candidates


def _credible_px(best_px: Array) -> Array:
    """The largest rms of a pose that explains an image as well as the best one does."""
    return np.maximum(1.5 * best_px, best_px + 0.05)


def planar_tilts(view: BoardView, camera: CameraModel) -> Array:
    """Find poses (1 or 2, 4, 4) by which a flat board explains the image, the likelier first (IPPE)."""
    K = camera_matrix(camera)
    points = np.ascontiguousarray(view.corners.points)
    pixels = np.ascontiguousarray(undistort(camera, view.corners.pixels))
    try:
        count, turns, shifts, _ = cv2.solvePnPGeneric(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error as problem:
        raise BadViewsError(
            "no-board-pose", view=view.index + 1, name=view.name, reason=problem.err
        ) from None
    return pose(
        rotation_exp(np.reshape(turns, (-1, 3))[:count]), np.reshape(shifts, (-1, 3))[:count]
    ).reshape(-1, 4, 4)


def view_rms_px(view: BoardView, camera: CameraModel, camera_from_board: Array) -> float:
    """Compute the rms distance of the corners from where the pose shows them, px."""
    miss = project_at(camera, camera_from_board, view.corners.points) - view.corners.pixels
    return float(np.sqrt(np.square(miss).sum(axis=1).mean()))


ANGLE_SCALE_RAD = 0.01
PITCH_SCALE_M = 0.005
_LARGEST_VOTERS = 120


def choose_candidates(candidates: list[Array], base_from_flange: Array, mount: Mount) -> list[int]:
    """Choose, per view, the number of the reading to keep.

    candidates: n arrays (k_i, 4, 4) camera_from_board; base_from_flange: (n, 4, 4). At most 120 views, evenly
    spread, vote; the others follow them, so the work is bounded. Best of all starts of iterated conditional
    modes (J. Besag, 1986), each start holding one reading of one view.
    """
    count = len(candidates)
    voters = np.unique(np.linspace(0, count - 1, min(count, _LARGEST_VOTERS)).astype(int))
    owner = np.concatenate([np.full(len(candidates[v]), n) for n, v in enumerate(voters)])
    poses = np.concatenate([candidates[v] for v in voters])
    flanges = np.repeat(base_from_flange[voters], [len(candidates[v]) for v in voters], axis=0)
    cost = _disagreement(mount, flanges[:, None], poses[:, None], flanges[None], poses[None])
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
        votes = [
            _disagreement(mount, base_from_flange[i], each, anchor_flanges, anchor_poses).sum()
            for each in candidates[i]
        ]
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


def _disagreement(mount: Mount, flange: Array, pose: Array, later_flange: Array, later_pose: Array) -> Array:
    """(...) in 0 … 1 (Geman-McClure) by which the motions of arm and board are not the same screw."""
    if mount == "eye-in-hand":
        A = inverse(later_flange) @ flange
    else:
        A = later_flange @ inverse(flange)
    angle_a, along_a = screw_invariants(A)
    angle_b, along_b = screw_invariants(later_pose @ inverse(pose))
    # The axis of a small turn is not known, nor is the sign of that of a half turn.
    trust = np.minimum(1.0, np.minimum(angle_a, angle_b) / 0.2)
    pitch_miss = np.abs(along_a - along_b)
    pitch_miss = np.where(
        angle_a > np.pi - 0.1, np.minimum(pitch_miss, np.abs(along_a + along_b)), pitch_miss
    )
    square = ((angle_a - angle_b) / ANGLE_SCALE_RAD) ** 2 + (trust * pitch_miss / PITCH_SCALE_M) ** 2
    return np.asarray(square / (1.0 + square))
