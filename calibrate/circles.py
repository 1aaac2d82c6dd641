"""Circle grids, symmetric and asymmetric.

The centre of a circle's picture is not quite the picture of its centre; at a tilt of 45° and circles 60 px
wide this is about 0.1 px, and grows with the square of the size. Prefer chessboard corners.
"""

from __future__ import annotations

import cv2
import numpy as np

from calibrate.board import board_points
from calibrate.corners import Grey
from calibrate.geometry import Array
from recordings.messages import BoardKind, BoardSpec


def find_circles(grey: Grey, spec: BoardSpec) -> Array | None:
    """All centres in board order, (rows·columns, 2) pixels, or None; dark on light or light on dark."""
    kind = (
        cv2.CALIB_CB_ASYMMETRIC_GRID
        if spec.kind is BoardKind.ASYMMETRIC_CIRCLES
        else cv2.CALIB_CB_SYMMETRIC_GRID
    )
    largest = grey.size / (spec.columns * spec.rows)
    for picture in (grey, cv2.bitwise_not(grey)):
        for clustering in (0, cv2.CALIB_CB_CLUSTERING):
            found, centres = cv2.findCirclesGrid(
                picture,
                (spec.columns, spec.rows),
                flags=kind | clustering,
                blobDetector=_blobs(largest),
            )
            if found:
                return _best_order(np.asarray(centres, dtype=float).reshape(-1, 2), spec)
    return None


def _blobs(largest_area_px: float) -> cv2.SimpleBlobDetector:
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea = 12.0
    parameters.maxArea = largest_area_px
    parameters.minDistBetweenBlobs = 4.0
    return cv2.SimpleBlobDetector.create(parameters)


def _best_order(centres: Array, spec: BoardSpec) -> Array | None:
    """The order whose plane fits: right-handed, and for asymmetric grids with the offset rows in place."""
    grid = centres.reshape(spec.rows, spec.columns, 2)
    turns = (0, 1, 2, 3) if spec.columns == spec.rows and spec.kind is BoardKind.CIRCLES else (0, 2)
    points = board_points(spec)[:, :2]
    best, best_miss = None, np.inf
    for mirrored in (grid, grid[:, ::-1]):
        for turn in turns:
            candidate = np.rot90(mirrored, turn).reshape(-1, 2)
            H, _ = cv2.findHomography(points, candidate, 0)
            if H is None or np.linalg.det(H[:2, :2] - np.outer(H[:2, 2], H[2, :2]) / H[2, 2]) <= 0:
                continue
            shown = cv2.perspectiveTransform(points.reshape(-1, 1, 2), H).reshape(-1, 2)
            miss = float(np.linalg.norm(shown - candidate, axis=1).max())
            # Equal fits are the turns that look the same: keep the first, so that the answer is stable.
            if miss < best_miss * 0.9:
                best, best_miss = candidate, miss
    return best
