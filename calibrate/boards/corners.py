"""Grids of corners in an image: spacing, regularity, handedness, and sub-pixel refinement."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from recordings.geometry import Array
from recordings.images import Pixels

Grey = NDArray[np.uint8]

_WINDOW_SHARE = 0.35
"""Half window of the refinement over the local spacing: as much edge as possible, no other corner."""
_LARGEST_HALF_WINDOW_PX = 16
_IRREGULAR_SHARE = 0.3
_REFINEMENT_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 5e-3)
_SMOOTHING_PX = 1.0
_MARGIN_PX = 16
"""Around the corners, beside a window: for the smoothing, and for the way to the saddle."""
_SMOOTH_FROM_PX = 9.5
"""Below this spacing the smoothing would mix a corner with its neighbours."""


def to_grey(image: Pixels) -> Grey:
    """Convert (h, w) or (h, w, 3 BGR), uint8 or uint16, to (h, w) uint8; 10, 12, 16 bits by the maximum."""
    if image.dtype == np.uint16:
        bits = next(b for b in (8, 10, 12, 16) if int(image.max(initial=0)) < 1 << b)
        image = (image >> (bits - 8)).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ValueError(f"an image of {image.dtype} is not supported; 8 or 16 bits are")
    if image.ndim == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    return np.ascontiguousarray(image)


def equalise(grey: Grey) -> Grey:
    """Spread contrast over the whole image; for finding, not for measuring."""
    return np.asarray(cv2.createCLAHE(clipLimit=4.0, tileGridSize=(8, 8)).apply(grey))


def through(H: Array, points: Array) -> Array:
    """Map points (n, 2) by a homography."""
    moved: Any = cv2.perspectiveTransform(points.reshape(-1, 1, 2), H)
    return np.asarray(moved.reshape(-1, 2))


def local_spacing(grid: Array) -> Array:
    """Measure the distance to the nearest neighbour, (rows, columns) for a grid (rows, columns, 2) px."""
    across, down = (
        np.pad(np.linalg.norm(np.diff(grid, axis=axis), axis=-1), edges, constant_values=np.inf)
        for axis, edges in ((1, ((0, 0), (1, 1))), (0, ((1, 1), (0, 0))))
    )
    return np.asarray(np.minimum.reduce([across[:, 1:], across[:, :-1], down[1:], down[:-1]]))


def is_regular(grid: Array) -> bool:
    """Tell whether the grid varies smoothly, as any lens shows a flat board. Finds single wrong corners.

    Third differences along rows and columns vanish for smooth grids; in short rows second ones are used.
    """
    for axis in (0, 1):
        count = grid.shape[axis]
        steps = np.linalg.norm(np.diff(grid, axis=axis), axis=-1)
        if count < 3:
            continue
        order, allowed = (3, _IRREGULAR_SHARE) if count > 3 else (2, 2 * _IRREGULAR_SHARE)
        bend = np.linalg.norm(np.diff(grid, n=order, axis=axis), axis=-1)
        size = np.minimum.reduce([np.take(steps, range(k, k + bend.shape[axis]), axis) for k in range(order)])
        if (bend > allowed * size + 1.0).any():
            return False
    return True


def right_handed(grid: Array) -> Array:
    """Reverse the grid's columns where needed, so that x × y points away from the viewer."""
    across = grid[:, -1] - grid[:, 0]
    down = grid[-1] - grid[0]
    x, y = across.mean(axis=0), down.mean(axis=0)
    return grid if x[0] * y[1] - x[1] * y[0] > 0 else grid[:, ::-1]


def refine(grey: Grey, corners: Array, spacing_px: Array) -> Array:
    """Refine saddle points to sub-pixel accuracy, each with a window that fits its own spacing.

    corners: (n, 2); spacing_px: (n,). A corner that runs away by more than 0.4 spacings keeps its place.
    The grey values are smoothed first: noise in the flat parts of a window pulls a corner to where the search
    began, and a saddle stays where it is under any symmetric smoothing.
    """
    half = np.clip(np.floor(spacing_px * _WINDOW_SHARE), 2, _LARGEST_HALF_WINDOW_PX).astype(int)
    margin = int(half.max(initial=2)) + _MARGIN_PX
    low = np.clip(np.floor(corners.min(axis=0)).astype(int) - margin, 0, None)
    high = np.ceil(corners.max(axis=0)).astype(int) + margin
    part: Any = grey[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if float(np.median(spacing_px)) >= _SMOOTH_FROM_PX:
        part = cv2.GaussianBlur(part, (0, 0), _SMOOTHING_PX)
    refined = corners.copy()
    for size in np.unique(half).tolist():
        chosen = half == size
        points = np.ascontiguousarray((corners[chosen] - low).reshape(-1, 1, 2), dtype=np.float32)
        cv2.cornerSubPix(part, points, (size, size), (-1, -1), _REFINEMENT_STEPS)
        refined[chosen] = points.reshape(-1, 2) + low
    ran = np.linalg.norm(refined - corners, axis=1) > 0.4 * spacing_px
    refined[ran] = corners[ran]
    return refined


def sample(grey: Grey, pixels: Array) -> Array:
    """Sample grey values (r, c) at pixels (r, c, 2), lightly smoothed."""
    # Only the part that is asked for is smoothed.
    low = np.clip(np.floor(pixels.min(axis=(0, 1))) - 3, 0, None).astype(int)
    high = np.ceil(pixels.max(axis=(0, 1))).astype(int) + 4
    places: Any = (pixels - low).astype(np.float32)
    smooth = cv2.blur(grey[low[1] : high[1], low[0] : high[0]], (3, 3))
    values = cv2.remap(
        smooth, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(values, dtype=np.float64)


def square_greys(grey: Grey, grid: Array) -> Array:
    """Sample the squares between corners (r, c, 2) beside their own four: greys (4, r - 1, c - 1).

    A tenth of a side from a corner a square is of one colour, even where a marker takes 0.8 of its side.
    """
    beside = []
    for down in (0.1, 0.9):
        edge = (1 - down) * grid[:-1] + down * grid[1:]
        beside += [(1 - across) * edge[:, :-1] + across * edge[:, 1:] for across in (0.1, 0.9)]
    return sample(grey, np.concatenate(beside)).reshape(4, len(grid) - 1, -1)


def contrasts(greys: Array) -> tuple[Array, Array]:
    """Compare neighbouring squares down and across: of one sign where they are dark and light in turn.

    greys: those of `square_greys` (4, r, c); returns (4, r - 1, c) and (4, r, c - 1).
    """
    signs = np.where(np.indices(greys.shape[1:]).sum(axis=0) % 2, -1, 1)
    return np.diff(greys, axis=1) * signs[1:], np.diff(greys, axis=2) * signs[:, 1:]


def alternation(greys: Array) -> float:
    """Tell how far squares are light and dark in turn, -1 … 1: negative where the first one is dark.

    Near 0 for a grid that skips rows of corners. Only signs count, so that light may fall off.
    """
    signs = np.concatenate([np.sign(each).reshape(4, -1) for each in contrasts(greys)], axis=1)
    return float(signs.mean())
