"""Hundreds of poses around the board that the camera could see it well from and the arm can stand in."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibrate.board import board_points
from calibrate.geometry import Array, pose, rotation_exp, transform_points
from calibrate.information import camera_matrix, project
from calibrate.kinematics import inverse_all, singularity_measure
from recordings.messages import BoardSpec, CameraModel
from station.collision import ARM_BODIES, body_segments, margins, segment_distance
from station.limits import joint_bounds
from station.plan.scene import Scene

_PATH_RESERVE_M = 0.01
"""Poses stand this far from every limit, so that moves between neighbours have room."""


@dataclass(frozen=True)
class ViewRange:
    """From where the board may be looked at."""

    distance_m: tuple[float, float] = (0.38, 0.60)
    tilt_rad: tuple[float, float] = (0.0, 0.70)
    roll_rad: float = 0.80
    """Either way from `roll_centre_rad`."""
    roll_centre_rad: float = 0.0
    off_centre: float = 0.35
    """Share of half the picture that the board's centre may be away from the picture's centre."""
    border_px: float = 12.0
    doubt: float = 1.6
    """The guess is taken to be wrong by so many times its sigmas."""
    visible_share: float = 1.0
    """Share of such wrong guesses for which the whole board must still be in the picture."""
    smallest_singular: float = 0.03
    free_sight: bool = True
    """No part of the arm between camera and board."""


@dataclass(frozen=True, eq=False)
class Pool:
    """Candidates that passed everything, of all arm branches: a pose may appear once per branch."""

    joints_rad: Array
    """(n, 6)"""
    base_from_flange: Array
    """(n, 4, 4)"""
    camera_from_board: Array
    """(n, 4, 4) by the guess"""
    branch: Array
    """(n,) small integers"""
    margin_m: Array
    """(n,)"""
    lost: Counter[str] = field(default_factory=Counter)
    """Why the others fell out: limit → count."""

    def __len__(self) -> int:
        return len(self.joints_rad)

    def take(self, places: NDArray[np.intp]) -> Pool:
        return replace(
            self,
            joints_rad=self.joints_rad[places],
            base_from_flange=self.base_from_flange[places],
            camera_from_board=self.camera_from_board[places],
            branch=self.branch[places],
            margin_m=self.margin_m[places],
        )


_NEAR_FILL, _FAR_FILL = 0.64, 0.40
"""Share of the picture's width or height that the board's outline fills, at the nearest and farthest."""
_FOCUS = (0.6, 1.6)
"""Pictures are sharp within these multiples of the working distance."""


def view_range(scene: Scene) -> ViewRange:
    """Distances at which the board fills the picture well, as far as they lie near the working distance."""
    K, _ = camera_matrix(scene.camera)
    rim = outline(scene.board)
    size_m = (rim.max(axis=0) - rim.min(axis=0))[:2]
    picture = np.array([scene.camera.width, scene.camera.height])
    full_m = float((np.diag(K)[:2] * size_m / picture).max())
    focus = np.array(_FOCUS) * scene.working_distance_m
    near, far = (float(d) for d in np.clip([full_m / _NEAR_FILL, full_m / _FAR_FILL], *focus))
    if far < 1.2 * near:
        near, far = full_m / _NEAR_FILL, full_m / _FAR_FILL
    return ViewRange(distance_m=(near, far))


def camera_views(scene: Scene, view: ViewRange, count: int, rng: np.random.Generator) -> Array:
    """Camera poses around the board, camera_from_board (count, 4, 4), spread over the range."""
    low, high = view.distance_m
    distance = rng.uniform(low, high, count)
    # Equal area on the cap: uniform in the cosine.
    cosine = rng.uniform(np.cos(view.tilt_rad[1]), np.cos(view.tilt_rad[0]), count)
    tilt, around = np.arccos(cosine), rng.uniform(-np.pi, np.pi, count)
    roll = view.roll_centre_rad + rng.uniform(-view.roll_rad, view.roll_rad, count)
    points = board_points(scene.board)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    axis = np.stack([np.cos(around), np.sin(around), np.zeros(count)], axis=1)
    turn = rotation_exp(axis * tilt[:, None])
    rolled = rotation_exp(np.stack([np.zeros(count), np.zeros(count), roll], axis=1))
    R = rolled @ turn
    K, _ = camera_matrix(scene.camera)
    half = np.array([scene.camera.width, scene.camera.height]) / 2
    aim = half + view.off_centre * half * rng.uniform(-1, 1, (count, 2))
    ray = np.concatenate([(aim - K[:2, 2]) / np.diag(K)[:2], np.ones((count, 1))], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return pose(R, distance[:, None] * ray - R @ centre)


def visible(camera: CameraModel, points: Array, border_px: float) -> Array:
    """Points (n, k, 3) in `camera` → (n,) whether all lie inside the picture, true lens included."""
    n, k = points.shape[:2]
    in_front = points[..., 2] > 0.02
    safe = np.where(in_front[..., None], points, [0.0, 0.0, 1.0])
    pixels = project(camera, safe.reshape(-1, 3))[0].reshape(n, k, 2)
    size = np.array([camera.width, camera.height]) - 1
    inside = ((pixels >= border_px) & (pixels <= size - border_px)).all(axis=-1)
    # Far off the axis a distortion polynomial folds points back into the picture.
    radius = np.linalg.norm(safe[..., :2] / safe[..., 2:], axis=-1)
    return np.asarray((inside & in_front & (radius < lens_radius(camera))).all(axis=1))


def lens_radius(camera: CameraModel) -> float:
    """Largest normalised radius up to which the lens model grows, at most 1.3 times the picture's corner."""
    K, _ = camera_matrix(camera)
    corner = np.hypot(camera.width, camera.height) / (2 * min(K[0, 0], K[1, 1]))
    radii = np.linspace(0, 1.3 * corner, 200)
    line = np.stack([radii, np.zeros(200), np.ones(200)], axis=1)
    x = project(camera, line)[0][:, 0]
    falling = np.flatnonzero(np.diff(x) <= 0)
    return float(radii[falling[0]] if len(falling) else radii[-1])


def share_visible(
    scene: Scene, base_from_flange: Array, view: ViewRange, draws: list[tuple[Array, Array]]
) -> Array:
    """(n,) share of the drawn guesses that show the whole board; 0 where the guess itself does not."""
    rim = outline(scene.board)
    share = visible(scene.camera, scene.seen(base_from_flange, rim), view.border_px).astype(float)
    if not draws:
        return share
    seen = np.flatnonzero(share)
    hits = np.zeros(len(seen))
    for X, Y in draws:
        drawn = replace(scene, X=X, Y=Y)
        hits += visible(scene.camera, drawn.seen(base_from_flange[seen], rim), view.border_px)
    share[seen] = hits / len(draws)
    return share


def outline(board: BoardSpec) -> Array:
    """Points (8, 3) around the detectable ones, half a square wider: detectors need the rim."""
    points = board_points(board)
    low = points.min(axis=0) - board.square_m / 2
    high = points.max(axis=0) + board.square_m / 2
    middle = (low + high) / 2
    xs, ys = (low[0], middle[0], high[0]), (low[1], middle[1], high[1])
    grid = [(x, y, 0.0) for x in xs for y in ys if (x, y) != (middle[0], middle[1])]
    return np.array(grid)


def find_candidates(
    scene: Scene,
    view: ViewRange,
    count: int,
    rng: np.random.Generator,
    near_joints_rad: Array | None,
    draws: list[tuple[Array, Array]],
    tries: int | None = None,
) -> Pool:
    """All arm branches of camera poses that pass view, reach, joints and clearance.

    `tries` (None: `count`) camera poses are looked at; the first `count` of those that show the board go on.
    """
    lost: Counter[str] = Counter()
    views = camera_views(scene, view, tries or count, rng)
    flange = scene.base_from_flange(views)
    good = share_visible(scene, flange, view, draws) >= view.visible_share
    lost["board not wholly in the picture"] = int((~good).sum())
    views, flange = views[good][:count], flange[good][:count]
    rows, joints, branches = _all_branches(scene, flange, view, near_joints_rad, lost)
    if len(rows) == 0:
        empty = np.zeros((0, 4, 4))
        return Pool(np.zeros((0, 6)), empty, empty, np.zeros(0, dtype=int), np.zeros(0), lost)
    keep = singularity_measure(scene.geometry.model, joints) >= view.smallest_singular
    lost["near a singular posture"] += int((~keep).sum())
    if view.free_sight:
        hidden = ~sees_past_the_arm(scene, joints, flange[rows])
        lost["the arm stands between camera and board"] += int((keep & hidden).sum())
        keep &= ~hidden
    gaps, labels = margins(scene.geometry, joints)
    worst = gaps.min(axis=1)
    for name in (labels[c] for c in gaps[keep & (worst < _PATH_RESERVE_M)].argmin(axis=1)):
        lost[name] += 1
    keep &= worst >= _PATH_RESERVE_M
    return Pool(joints[keep], flange[rows][keep], views[rows][keep], branches[keep], worst[keep], lost)


def sees_past_the_arm(scene: Scene, joints_rad: Array, base_from_flange: Array) -> NDArray[np.bool_]:
    """(n,) whether no part of the arm stands in the lines of sight to the board's outline."""
    starts, ends, radii = body_segments(scene.geometry, joints_rad)
    links = slice(2, len(ARM_BODIES))
    if scene.mount == "eye-in-hand":
        eye = transform_points(base_from_flange, scene.X[None, :3, 3])
        board = np.broadcast_to(transform_points(scene.Y, outline(scene.board)), (len(eye), 8, 3))
    else:
        eye = np.broadcast_to(scene.X[:3, 3], (len(joints_rad), 1, 3))
        board = transform_points(base_from_flange @ scene.Y, outline(scene.board))
    gap = segment_distance(eye[:, :, None], board[:, :, None], starts[:, None, links], ends[:, None, links])
    return np.asarray((gap > radii[links]).all(axis=(1, 2)))


def _all_branches(
    scene: Scene, flange: Array, view: ViewRange, near: Array | None, lost: Counter[str]
) -> tuple[Array, Array, Array]:
    """Inverse kinematics of all poses: row in `flange`, joints within their range, branch number."""
    low, high = joint_bounds(scene.geometry)
    rows, joints = [], []
    for row, target in enumerate(flange):
        solutions = inverse_all(scene.geometry.model, target)
        if len(solutions) == 0:
            lost["out of the arm's reach"] += 1
        rows += [row] * len(solutions)
        joints += list(solutions)
    if not rows:
        return np.zeros(0, dtype=int), np.zeros((0, 6)), np.zeros(0, dtype=int)
    q = np.array(joints)
    branches = branch_of(scene, q)
    for branch in np.unique(branches):
        here = branches == branch
        q[here] = _gather(q[here], near, low, high)
    inside = ((q >= low) & (q <= high)).all(axis=1)
    lost["joint range"] += int((~inside).sum())
    return np.array(rows)[inside], q[inside], branches[inside]


def _gather(q: Array, near: Array | None, low: Array, high: Array) -> Array:
    """Full turns so that a branch's joints (n, 6) lie together, near the start, within low…high (6,)."""
    turn = 2 * np.pi
    mean = np.angle(np.exp(1j * q).mean(axis=0))
    mean += turn * np.round(((near if near is not None else (low + high) / 2) - mean) / turn)
    q = mean + (q - mean + np.pi) % turn - np.pi
    q = np.where(q < low, q + turn, q)
    return np.where(q > high, q - turn, q)


def branch_of(scene: Scene, joints_rad: Array) -> Array:
    """Which of the 8 arm branches joints (n, 6) belong to: shoulder side, elbow, wrist flip, as bits (n,)."""
    model = scene.geometry.model
    q = np.asarray(joints_rad)
    elbow = np.sin(q[:, 2]) > 0
    wrist = np.sin(q[:, 4]) > 0
    # Shoulder side: does the wrist's centre lie before or behind the shoulder axis, in the arm's plane?
    a2, a3, d5 = model.a_m[1], model.a_m[2], model.d_m[4]
    reach = a2 * np.cos(q[:, 1]) + a3 * np.cos(q[:, 1] + q[:, 2]) + d5 * np.sin(q[:, 1:4].sum(axis=1))
    return np.asarray((reach > 0) * 4 + elbow * 2 + wrist * 1)
