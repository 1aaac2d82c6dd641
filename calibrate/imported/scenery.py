"""What is seen around the board: before a fixed camera it stays where it is, before a moving one it moves.

Points of two images that look alike (SIFT: D. Lowe, "Distinctive image features from scale-invariant
keypoints", 2004) are counted where they are clear of the board: those that stand still while the board moved,
and those that moved along the epipolar line on which all moves that stands still with the board. The hand's
own parts do the opposite of the scene, so that a few of the other kind mean nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from calibrate.boards.corners import Grey
from calibrate.geometry import Array, inverse, skew
from calibrate.projection import camera_matrix, undistort
from calibrate.views import BoardView
from recordings.schema.messages import CameraModel

_VIEWS, _POINTS = 16, 1500
"""Most images, and most points of each, that are compared."""
_CLEAR = 1.5
"""Points count outside the board's outline enlarged so much: it may be printed on a larger sheet."""
_ALIKE = 0.75
"""Largest distance to the point most like it, as a share of that to the second (Lowe's test)."""
_STILL_PX, _MOVED_PX = 2.0, 10.0
"""In images reduced to some 1000 px."""


@dataclass(frozen=True, eq=False)
class _Points:
    seen_px: Array
    """(n, 2)"""
    rays: Array
    """(n, 3) of the plain lens, z = 1."""
    looks: Any
    camera_from_board: Array


def count_points(images: list[tuple[Grey, BoardView]], camera: CameraModel) -> tuple[int, int]:
    """(points that stand still, points that move as the board does) of all pairs of near views.

    The images may be smaller than the camera's, to which the views' pixels and the lens belong.
    """
    points = [_points(grey, view, camera) for grey, view in images[:_VIEWS]]
    pairs = [(a, b) for step in (1, 2) for a, b in zip(points, points[step:], strict=False) if a and b]
    focal_px = camera_matrix(camera)[0, 0] * images[0][0].shape[1] / camera.width
    counts = [_compare(a, b, focal_px) for a, b in pairs]
    return sum(still for still, _ in counts), sum(moved for _, moved in counts)


def _points(grey: Grey, view: BoardView, camera: CameraModel) -> _Points | None:
    scale = grey.shape[1] / camera.width
    outline = cv2.convexHull((view.pixels * scale).astype(np.float32))[:, 0]
    outline = outline.mean(axis=0) + _CLEAR * (outline - outline.mean(axis=0))
    clear = cv2.fillConvexPoly(np.full_like(grey, 255), np.round(outline).astype(np.int32), 0)
    found, looks = cv2.SIFT.create(_POINTS).detectAndCompute(grey, clear)
    if len(found) < 2:
        return None
    seen = np.array([point.pt for point in found])
    plain = np.column_stack([undistort(camera, seen / scale), np.ones(len(seen))])
    rays = plain @ np.linalg.inv(camera_matrix(camera)).T
    assert view.camera_from_board is not None
    return _Points(seen, rays, looks, view.camera_from_board)


def _compare(one: _Points, other: _Points, focal_px: float) -> tuple[int, int]:
    """(points that stood still, points that moved as the board did) from one image to another."""
    nearest = cv2.BFMatcher().knnMatch(one.looks, other.looks, 2)
    alike = np.array([(a.queryIdx, a.trainIdx) for a, b in nearest if a.distance < _ALIKE * b.distance])
    i, k = alike.reshape(-1, 2).astype(int).T
    moved_px = np.linalg.norm(other.seen_px[k] - one.seen_px[i], axis=1)
    motion = other.camera_from_board @ inverse(one.camera_from_board)
    essential = skew(motion[:3, 3]) @ motion[:3, :3]
    there, here = one.rays[i] @ essential.T, other.rays[k] @ essential
    miss = np.abs((other.rays[k] * there).sum(axis=1))
    away_px = focal_px * miss / np.minimum(*(np.linalg.norm(line[:, :2], axis=1) for line in (there, here)))
    still = (moved_px < _STILL_PX) & (away_px > _STILL_PX)
    return int(still.sum()), int(((moved_px > _MOVED_PX) & (away_px < _STILL_PX)).sum())
