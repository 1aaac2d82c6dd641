"""Visibility of the board: wholly in the image despite uncertain initial poses, not hidden by the arm."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.arms.kinematics import forward
from calibrate.boards.model import board_points
from calibrate.views.projection import camera_matrix, project
from recordings.geometry import Array, pose, rotation_exp, transform_points
from recordings.schema.messages import BoardSpec, CameraModel
from station.cell.collision import ARM_BODIES, body_segments, segment_distance
from station.cell.config import matrix4, vector6
from station.cell.layout import CellLayout, printed_corners
from station.cell.pose_plan import ExpectedView, PlannedPose


@dataclass(frozen=True)
class ViewRange:
    """Range of distance, tilt, roll and position of the board in wanted views."""

    distance_m: tuple[float, float] = (0.38, 0.60)
    tilt_rad: tuple[float, float] = (0.0, 0.70)
    roll_rad: float = 0.80
    """Largest difference from `roll_centre_rad`."""
    roll_centre_rad: float = 0.0
    off_centre: float = 0.35
    """Largest distance of the board's centre from the image's centre, as share of half the image."""
    border_px: float = 12.0
    doubt: float = 3.5
    """Distance of every board corner from the image's edge, beyond `border_px`, in standard deviations of its
    pixel by the uncertainty of the initial poses."""
    smallest_singular: float = 0.03
    """Least `kinematics.singularity_measure` of a pose: near 0 a slow flange may need fast joints."""


_NEAR_FILL, _FAR_FILL = 0.64, 0.40
"""Share of the image's width or height that the board fills at the shortest and longest distance."""
_FOCUS = (0.6, 1.6)
"""Range of distances with sharp images, as multiples of the working distance."""


def view_range(layout: CellLayout) -> ViewRange:
    """Choose distances at which the board fills the image well, near the working distance."""
    fills = distances_that_fill(layout.camera, layout.board)
    near, far = (float(d) for d in np.clip(fills, *(np.array(_FOCUS) * layout.working_distance_m)))
    return ViewRange(distance_m=fills if far < 1.2 * near else (near, far))


def distances_that_fill(camera: CameraModel, board: BoardSpec) -> tuple[float, float]:
    """Compute the shortest and longest distance (m) at which the board fills the image well."""
    points = board_points(board)
    size_m = (points.max(axis=0) - points.min(axis=0))[:2] + board.square_m
    picture = np.array([camera.width, camera.height])
    full_m = float((np.diag(camera_matrix(camera))[:2] * size_m / picture).max())
    return full_m / _NEAR_FILL, full_m / _FAR_FILL


def camera_views(
    camera: CameraModel, board: BoardSpec, view: ViewRange, count: int, rng: np.random.Generator
) -> Array:
    """Draw views of the board, camera_from_board (count, 4, 4), spread over the range."""
    low, high = view.distance_m
    distance = rng.uniform(low, high, count)
    # A uniform cosine gives directions that are uniform on the sphere.
    cosine = rng.uniform(np.cos(view.tilt_rad[1]), np.cos(view.tilt_rad[0]), count)
    tilt, around = np.arccos(cosine), rng.uniform(-np.pi, np.pi, count)
    roll = view.roll_centre_rad + rng.uniform(-view.roll_rad, view.roll_rad, count)
    points = board_points(board)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    axis = np.stack([np.cos(around), np.sin(around), np.zeros(count)], axis=1)
    turn = rotation_exp(axis * tilt[:, None])
    rolled = rotation_exp(np.stack([np.zeros(count), np.zeros(count), roll], axis=1))
    R = rolled @ turn
    K = camera_matrix(camera)
    half = np.array([camera.width, camera.height]) / 2
    aim = half + view.off_centre * half * rng.uniform(-1, 1, (count, 2))
    ray = np.concatenate([(aim - K[:2, 2]) / np.diag(K)[:2], np.ones((count, 1))], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return pose(R, distance[:, None] * ray - R @ centre)


def visible(camera: CameraModel, points: Array, border_px: float) -> NDArray[np.bool_]:
    """Tell for n views whether all points (n, k, 3) in `camera` lie in the image, with distortion: (n,)."""
    in_front = points[..., 2] > 0.02
    safe = np.where(in_front[..., None], points, [0.0, 0.0, 1.0])
    pixels = project(camera, safe).pixels
    size = np.array([camera.width, camera.height]) - 1
    inside = ((pixels >= border_px) & (pixels <= size - border_px)).all(axis=-1)
    # Far from the axis a distortion polynomial may map points back into the image.
    radius = np.linalg.norm(safe[..., :2] / safe[..., 2:], axis=-1)
    return np.asarray((inside & in_front & (radius < lens_radius(camera))).all(axis=1))


def count_in_parts(camera: CameraModel, pixels: Array, rows: int, columns: int) -> Array:
    """Count points (n, 2) in each part of the image, (rows, columns) from the top left."""
    sides = ((-0.5, camera.height - 0.5), (-0.5, camera.width - 0.5))
    return np.histogram2d(pixels[:, 1], pixels[:, 0], bins=(rows, columns), range=sides)[0]


def lens_radius(camera: CameraModel) -> float:
    """Find the largest normalised radius up to which the lens model is monotonic (at most 1.3 × corner)."""
    K = camera_matrix(camera)
    corner = np.hypot(camera.width, camera.height) / (2 * min(K[0, 0], K[1, 1]))
    radii = np.linspace(0, 1.3 * corner, 200)
    line = np.stack([radii, np.zeros(200), np.ones(200)], axis=1)
    x = project(camera, line).pixels[:, 0]
    falling = np.flatnonzero(np.diff(x) <= 0)
    return float(radii[falling[0]] if len(falling) else radii[-1])


def seen_for_certain(layout: CellLayout, base_from_flange: Array, view: ViewRange) -> NDArray[np.bool_]:
    """Tell for n poses whether the whole board is in the image despite the uncertainty of the initial poses.

    Every point of the outline must be `border_px` plus `doubt` standard deviations away from the edge.
    """
    rim = outline(layout.board)
    good = visible(layout.camera, layout.seen(base_from_flange, rim), view.border_px)
    left = np.flatnonzero(good)
    pixels, sigma_px = uncertain_pixels(layout, base_from_flange[left], rim)
    border = view.border_px + view.doubt * sigma_px
    size = np.array([layout.camera.width, layout.camera.height]) - 1
    good[left] = ((pixels >= border) & (pixels <= size - border)).all(axis=(1, 2))
    return good


def uncertain_pixels(layout: CellLayout, base_from_flange: Array, points: Array) -> tuple[Array, Array]:
    """Project board points (k, 3) into n images: pixels and their standard deviations, (n, k, 2) each.

    To first order. Position errors of camera and board are isotropic; an orientation error of the camera
    moves a point about the camera, one of the board about the board's origin.
    """
    seen = layout.seen(base_from_flange, points)
    lever = seen - layout.seen(base_from_flange, np.zeros((1, 3)))
    variance = (layout.x_sigma[0] ** 2 + layout.y_sigma[0] ** 2) * np.eye(3)
    for arm, sigma_rad in ((seen, layout.x_sigma[1]), (lever, layout.y_sigma[1])):
        across = (arm**2).sum(axis=-1)[..., None, None] * np.eye(3) - arm[..., :, None] * arm[..., None, :]
        variance = variance + sigma_rad**2 * across
    projected = project(layout.camera, seen)
    J = projected.by_point
    return projected.pixels, np.sqrt(np.einsum("nkij,nkjl,nkil->nki", J, variance, J))


def outline(board: BoardSpec) -> Array:
    """Make an outline (8, 3) half a square outside the detectable points, as detectors need the margin."""
    points = board_points(board)
    low = points.min(axis=0) - board.square_m / 2
    high = points.max(axis=0) + board.square_m / 2
    middle = (low + high) / 2
    xs, ys = (low[0], middle[0], high[0]), (low[1], middle[1], high[1])
    grid = [(x, y, 0.0) for x in xs for y in ys if (x, y) != (middle[0], middle[1])]
    return np.array(grid)


def sees_past_the_arm(layout: CellLayout, joints_rad: Array, base_from_flange: Array) -> NDArray[np.bool_]:
    """Tell for n postures whether the arm is clear of all lines of sight to the board's outline: (n,)."""
    starts, ends, radii = body_segments(layout.geometry, joints_rad)
    links = slice(2, len(ARM_BODIES))
    if layout.mount == "eye-in-hand":
        eye = transform_points(base_from_flange, layout.X[None, :3, 3])
        board = np.broadcast_to(transform_points(layout.Y, outline(layout.board)), (len(eye), 8, 3))
    else:
        eye = np.broadcast_to(layout.X[:3, 3], (len(joints_rad), 1, 3))
        board = transform_points(base_from_flange @ layout.Y, outline(layout.board))
    gap = segment_distance(eye[:, :, None], board[:, :, None], starts[:, None, links], ends[:, None, links])
    return np.asarray((gap > radii[links]).all(axis=(1, 2)))


def expected_view(layout: CellLayout, base_from_flange: Array) -> ExpectedView:
    """Predict the view of the board from a flange pose (4, 4)."""
    camera_from_board = layout.camera_from_board(base_from_flange)
    points = board_points(layout.board)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    R, t = camera_from_board[:3, :3], camera_from_board[:3, 3]
    seen = np.vstack([centre, printed_corners(layout.board)]) @ R.T + t
    pixels = project(layout.camera, np.maximum(seen, [-np.inf, -np.inf, 0.02])).pixels
    area = abs(float(cv2.contourArea(pixels[1:].astype(np.float32))))
    return ExpectedView(
        distance_m=float(np.linalg.norm(seen[0])),
        tilt_rad=float(np.arccos(np.clip(R[2, 2], -1, 1))),
        roll_rad=roll_of(R),
        centre_px=(float(pixels[0, 0]), float(pixels[0, 1])),
        coverage=min(1.0, area / (layout.camera.width * layout.camera.height)),
    )


def roll_of(R: Array) -> float:
    """Rotation (rad) about the optical axis that is left of a rotation or pose when the tilt is removed."""
    return float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))


def planned_pose(layout: CellLayout, number: int, joints_rad: Array, sigma_m: float | None) -> PlannedPose:
    """Make a pose of a plan with its expected view and the reason in a few words."""
    base_from_flange = forward(layout.geometry.model, joints_rad)
    view = expected_view(layout, base_from_flange)
    return PlannedPose(
        name=f"p{number + 1:02d}",
        joints_rad=vector6(joints_rad),
        base_from_flange=matrix4(base_from_flange),
        view=view,
        why=_why(layout, view),
        predicted_sigma_m=sigma_m,
    )


def _why(layout: CellLayout, view: ExpectedView) -> str:
    half = np.array([layout.camera.width, layout.camera.height]) / 2
    x, y = (np.array(view.centre_px) - half) / half
    side = " ".join(
        word
        for word, on in (("up", y < -0.1), ("down", y > 0.1), ("left", x < -0.1), ("right", x > 0.1))
        if on
    )
    return (
        f"{1000 * view.distance_m:.0f} mm, tilt {np.rad2deg(view.tilt_rad):.0f}°, "
        f"turned {np.rad2deg(view.roll_rad):+.0f}°, board {side or 'centred'}"
    )
