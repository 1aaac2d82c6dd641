"""Boards without markers: chessboard corners by several detectors, and circle grids.

A tilted circle's image is an ellipse whose centre is not the image of the circle's centre. How far apart
the two are follows from the board's plane and the circles' radius, which is measured in the image.
J. Heikkilä, "Geometric camera calibration using circular control points" (2000).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from calibrate.boards.corners import (
    Grey,
    alternation,
    contrasts,
    equalise,
    is_regular,
    local_spacing,
    refine,
    right_handed,
    square_greys,
    through,
)
from calibrate.boards.model import board_points, looks_same_turns
from recordings.geometry import Array
from recordings.schema.boards import FEWEST_ON_A_SIDE
from recordings.schema.messages import BoardKind, BoardSpec

_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_LARGE_SIDE_PX = 1000
_SMALL_SIDE_PX = 800
_PREVIEW_SIDE_PX = 640
_ALTERNATE = 0.6
"""Share of neighbouring squares that differ as they must, less the share that differ the other way."""


def find_chessboard(
    grey: Grey, spec: BoardSpec, thorough: bool = True, exhaustive: bool = True
) -> Array | None:
    """Find all inner corners in board order, (rows·columns, 2) pixels, or None.

    The colours of the squares decide the orientation where they can; otherwise the order is one of the turns
    after which the board looks the same. `thorough=False` makes one quick attempt on a smaller image,
    `exhaustive=False` leaves out the attempts that take longer than all others.
    """
    for found, by_sectors in _attempts(grey, (spec.columns, spec.rows), thorough, exhaustive):
        if found is None:
            continue
        grid = right_handed(found.reshape(spec.rows, spec.columns, 2).astype(float))
        spacing = local_spacing(grid)
        if spacing.min() < 3.0:
            continue
        refined = refine(grey, grid.reshape(-1, 2), spacing.ravel()).reshape(grid.shape)
        if is_regular(refined) or not by_sectors:
            grid = refined  # else a pattern projected onto the board pulls single corners away
        if is_regular(grid) and abs(alternation(square_greys(grey, grid))) > _ALTERNATE:
            if _goes_on(grey, grid):
                return None
            return _orient(grey, grid, spec).reshape(-1, 2)
    return None


def _attempts(
    grey: Grey, size: tuple[int, int], thorough: bool, exhaustive: bool
) -> Iterator[tuple[Array | None, bool]]:
    """(corners, whether `_sector` found them: to a part of a pixel, also where the squares are speckled)"""
    largest = max(grey.shape)
    if not thorough:
        yield _scaled(grey, min(1.0, _PREVIEW_SIDE_PX / largest), lambda small: _classic(small, size)), False
        return
    if largest > _LARGE_SIDE_PX:
        yield _scaled(grey, 0.5, lambda small: _classic(small, size)), False  # a third of the time
    yield _classic(grey, size), False
    yield _sector(grey, size, 0), True
    if not exhaustive:
        return
    equalised = equalise(grey)
    yield _classic(equalised, size), False
    yield _sector(equalised, size, cv2.CALIB_CB_EXHAUSTIVE), True
    if largest <= _SMALL_SIDE_PX:
        yield _scaled(grey, 2.0, lambda large: _classic(large, size)), False


def _classic(grey: Grey, size: tuple[int, int]) -> Array | None:
    found, corners = cv2.findChessboardCorners(grey, size, flags=_CLASSIC)
    return np.asarray(corners, dtype=float) if found else None


def _sector(grey: Grey, size: tuple[int, int], flags: int) -> Array | None:
    """A. Duda, U. Frese: "Accurate detection and localization of checkerboard corners" (2018): SB."""
    found, corners = cv2.findChessboardCornersSB(grey, size, flags=flags | cv2.CALIB_CB_NORMALIZE_IMAGE)
    return np.asarray(corners, dtype=float) if found else None


def _scaled(grey: Grey, factor: float, find: Callable[[Grey], Array | None]) -> Array | None:
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    corners = find(np.asarray(cv2.resize(grey, None, fx=factor, fy=factor, interpolation=method)))
    return None if corners is None else (corners + 0.5) / factor - 0.5


def _orient(grey: Grey, grid: Array, spec: BoardSpec) -> Array:
    """The right-handed turn whose first square (between the first four corners) is dark."""
    turns = (0, 1, 2, 3) if spec.columns == spec.rows else (0, 2)
    if len(looks_same_turns(spec)) == len(turns):
        return grid
    # Among the turns that the colours allow, the first corner nearest the image's top left.
    greys = square_greys(grey, grid)
    dark_first = [t for t in turns if alternation(np.rot90(greys, t, (1, 2))) < 0]
    return min((np.rot90(grid, t) for t in dark_first), key=lambda c: float(c[0, 0].sum()))


def _goes_on(grey: Grey, grid: Array) -> bool:
    """Tell whether the squares go on beyond a side of the grid: it is a part of a larger board's."""
    rows, columns = grid.shape[:2]
    plane = np.stack(np.meshgrid(np.arange(-2.0, columns + 2), np.arange(-2.0, rows + 2)), axis=-1)
    found: Any = cv2.findHomography(plane[2:-2, 2:-2].reshape(-1, 2), grid.reshape(-1, 2), 0)
    last = np.array(grey.shape[::-1]) - 1
    for turn in range(4):
        beyond = np.rot90(plane, turn)[:3, 2:-2]  # the last of these rows is the grid's own
        pixels = through(found[0], beyond.reshape(-1, 2)).reshape(beyond.shape)
        if not ((pixels < 0) | (pixels > last)).any():
            next_squares, outermost = np.moveaxis(contrasts(square_greys(grey, pixels))[1].mean(axis=2), 1, 0)
            if (next_squares * outermost.mean() > 0.5 * outermost.mean() ** 2).all():
                return True
    return False


def other_size(grey: Grey, spec: BoardSpec) -> tuple[int, int] | None:
    """Find inner corners (columns, rows) of another chessboard than that of `spec`; None: none is seen.

    One smaller each way is looked for by name: that is what a board looks like whose squares were counted.
    """
    seen = seen_size(grey)
    if seen is None or min(spec.columns, spec.rows) <= FEWEST_ON_A_SIDE:
        return seen
    smaller = msgspec.structs.replace(spec, columns=spec.columns - 1, rows=spec.rows - 1)
    found = sum(seen) < spec.columns + spec.rows and find_chessboard(grey, smaller) is not None
    return (smaller.columns, smaller.rows) if found else seen


def seen_size(grey: Grey) -> tuple[int, int] | None:
    """Find the sides in corners, the longer first, of whatever chessboard is there."""
    factor = min(1.0, _LARGE_SIDE_PX / max(grey.shape))
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    found, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), cv2.CALIB_CB_LARGER)
    return (max(meta.shape), min(meta.shape)) if found else None


_CELLS = 16
"""Samples from the middle of a circle to the edge of its patch."""
_AS_LARGE = 1.4
"""Circles of one grid differ by less than this factor in size, unless seen from very near."""
_TOGETHER = 2.5
"""Neighbours of one grid are nearer than so many of its circles' widths."""
_GUESSED_PX = 1.5
"""Farther than this from the middle of the ink a centre was guessed, not found."""


def count_circles(grey: Grey) -> int:
    """Count the dark blobs, or the light ones, of about one size that lie together: a grid's circles."""
    both = (grey, cv2.bitwise_not(grey))
    return max((len(each) for image in both for each in _together(image, grey.size / 16)), default=0)


def _together(image: Any, largest_px: float) -> Iterator[Array]:
    """Centres (k, 2) px of dark blobs of about one size that lie together, for every size."""
    from scipy.sparse.csgraph import connected_components  # a quarter of a second, for circles only
    from scipy.spatial import KDTree

    blobs = _blobs(largest_px).detect(image)
    at, size = np.array([blob.pt for blob in blobs]), np.array([blob.size for blob in blobs])
    if not blobs:
        return
    steps = 2 + int(2 * np.log(size.max() / size.min()) / np.log(_AS_LARGE))
    for each in np.geomspace(size.min(), size.max(), steps):
        alike = at[(size > each / _AS_LARGE) & (size < each * _AS_LARGE)]
        if len(alike) > 1:
            tree = KDTree(alike)
            groups = connected_components(tree.sparse_distance_matrix(tree, _TOGETHER * each))[1]
            yield from (alike[groups == group] for group in np.unique(groups))


def _blobs(largest_px: float) -> cv2.SimpleBlobDetector:
    blobs = cv2.SimpleBlobDetector.Params()
    blobs.minArea, blobs.minDistBetweenBlobs, blobs.maxArea = 12.0, 4.0, largest_px
    return cv2.SimpleBlobDetector.create(blobs)


def find_circles(grey: Grey, spec: BoardSpec) -> Array | None:
    """Find all centres in board order, (rows·columns, 2) px, or None; dark on light or light on dark."""
    kind = (
        cv2.CALIB_CB_ASYMMETRIC_GRID
        if spec.kind is BoardKind.ASYMMETRIC_CIRCLES
        else cv2.CALIB_CB_SYMMETRIC_GRID
    )
    count = spec.columns * spec.rows
    for image in (grey, cv2.bitwise_not(grey)):
        groups = (each for each in _together(image, grey.size / count) if count <= len(each) < 2 * count)
        for group in chain(groups, [None]):  # OpenCV loses a grid among other blobs
            for clustering in (0, cv2.CALIB_CB_CLUSTERING):
                found, centres = cv2.findCirclesGrid(
                    image if group is None else _painted(group, grey),
                    (spec.columns, spec.rows),
                    flags=kind | clustering,
                    blobDetector=_blobs(grey.size / count),
                )
                if found:
                    seen = np.asarray(centres, dtype=float).reshape(-1, 2)
                    if group is not None:
                        seen = group[np.linalg.norm(seen[:, None] - group, axis=2).argmin(axis=1)]
                    ordered = _best_order(seen, spec)
                    if ordered is not None and _is_even(ordered, spec):
                        centres = true_centres(grey, ordered, spec)
                        if are_round(grey, centres, spec):
                            return centres
    return None


_SQUARE_HARMONIC = 3 / 7
"""|∫ z⁴| over ∫ |z|⁴ of a square about its middle at any turn, z = x + iy: 16/15 over 112/45 for a side of 2.
Of a disc it is 0."""


def are_round(grey: Grey, centres: Array, spec: BoardSpec) -> bool:
    """Tell whether the spots of a grid are circles: a chessboard's dark squares lie in such a grid, too.

    centres: (n, 2) px in board order. Seen at right angles, the fourth angular harmonic of most spots is
    nearer to a disc's, 0, than to a square's.
    """
    H = _homography(centres, spec)
    if H is None:
        return False
    spots = _spots(grey, H, np.zeros_like(centres), spec)
    z = spots.u + 1j * spots.v
    harmonic = np.abs((spots.share * z**4).sum(axis=(1, 2)))
    size = np.maximum((spots.share * np.abs(z) ** 4).sum(axis=(1, 2)), 1e-12)
    return float(np.median(harmonic / size)) < _SQUARE_HARMONIC / 2


def _homography(centres: Array, spec: BoardSpec) -> Array | None:
    """Fit H (3, 3) from the board's plane, in pitches, to pixels (n, 2); None: there is none."""
    plane = board_points(spec)[:, :2] / spec.square_m
    found: Any = cv2.findHomography(plane, centres, 0)
    return None if found[0] is None else np.asarray(found[0])


def _is_even(centres: Array, spec: BoardSpec) -> bool:
    """Tell whether the grid varies smoothly; of an asymmetric one every second row."""
    grid = centres.reshape(spec.rows, spec.columns, 2)
    apart = 2 if spec.kind is BoardKind.ASYMMETRIC_CIRCLES else 1
    return all(is_regular(grid[first::apart]) for first in range(apart))


def _painted(centres: Array, like: Grey) -> Grey:
    """A white image with black dots there, and nothing else."""
    image = np.full_like(like, 255)
    apart = np.sort(np.linalg.norm(centres[:, None] - centres, axis=2), axis=1)[:, 1]
    for x, y in centres:
        cv2.circle(image, (round(x), round(y)), max(2, int(apart.min() / 4)), 0, cv2.FILLED, cv2.LINE_AA)
    return image


def true_centres(grey: Grey, ellipses: Array, spec: BoardSpec) -> Array:
    """Find the seen centres of the circles themselves (n, 2) from those of their ellipses in board order.

    The dual conic of a circle round c with radius r is c cᵀ - r² diag(1, 1, 0); the plane's homography H
    takes it to H (…) Hᵀ, whose last column is the ellipse's centre. The lens's bend within one circle is
    left out of this small correction. A centre that lies off its own circle (OpenCV guesses those that it
    does not find) is replaced by the middle of the ink.
    """
    plane = board_points(spec)[:, :2] / spec.square_m
    c = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    centres = ellipses
    for _ in range(2):  # the plane itself was fitted to ellipses first
        H = _homography(centres, spec)
        if H is None:
            return ellipses
        seen = c @ H.T
        bend = centres - seen[:, :2] / seen[:, 2:]
        spots = _spots(grey, H, bend, spec)
        radius = spots.radius
        middles = _middles(spots, H, bend, spec)
        shown = seen * seen[:, 2:] - radius**2 * (H[:, :2] @ H[2, :2])
        centres = ellipses - (shown[:, :2] / shown[:, 2:] - seen[:, :2] / seen[:, 2:])
        guessed = np.linalg.norm(centres - middles, axis=1) > _GUESSED_PX
        centres[guessed] = middles[guessed]
    return np.asarray(centres)


class Spots(NamedTuple):
    """Patches round the spots of a grid, seen at right angles."""

    u: Array
    """(side, side), pitches from the middle of the patch."""
    v: Array
    share: Array
    """(n, side, side), 0…1: how much of it is ink, of the spot alone."""
    radius: float
    """Of a circle of the spots' median area, over the pitch."""


def _spots(grey: Grey, H: Array, bend: Array, spec: BoardSpec) -> Spots:
    """Look at each spot of a grid. bend: (n, 2) px from where H shows a spot to where it is."""
    reach = 0.6 if spec.kind is BoardKind.ASYMMETRIC_CIRCLES else 0.5
    side = 2 * _CELLS + 1
    v, u = np.mgrid[-reach : reach : side * 1j, -reach : reach : side * 1j]
    centres = board_points(spec)[:, :2] / spec.square_m
    plane = centres[:, None, None] + np.stack([u, v], axis=-1)
    pixels = through(H, plane.reshape(-1, 2)).reshape(len(plane) * side, side, 2)
    places = (pixels + np.repeat(bend, side, axis=0)[:, None]).astype(np.float32)
    patches = cv2.remap(
        grey, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    patches = patches.reshape(-1, side, side)
    edge = np.concatenate([patches[:, 0], patches[:, -1], patches[:, :, 0], patches[:, :, -1]], axis=1)
    paper = np.median(edge, axis=1)[:, None, None]
    middle = patches[:, _CELLS - 1 : _CELLS + 2, _CELLS - 1 : _CELLS + 2].mean(axis=(1, 2), keepdims=True)
    contrast = np.where(np.abs(middle - paper) < 1.0, np.inf, middle - paper)
    share = np.clip((patches - paper) / contrast, 0.0, 1.0)
    radius = float(np.sqrt(np.median(share.sum(axis=(1, 2))) / np.pi) * reach / _CELLS)
    share *= u * u + v * v < (1.4 * radius) ** 2  # the sheet may end beyond
    return Spots(u, v, share, radius)


def _middles(spots: Spots, H: Array, bend: Array, spec: BoardSpec) -> Array:
    """Find the middle of each spot's ink (n, 2) px."""
    centres = board_points(spec)[:, :2] / spec.square_m
    area = np.maximum(spots.share.sum(axis=(1, 2)), 1e-9)
    along_u = (spots.share * spots.u).sum(axis=(1, 2))
    along_v = (spots.share * spots.v).sum(axis=(1, 2))
    offset = np.stack([along_u, along_v], axis=-1) / area[:, None]
    return through(H, centres + offset) + bend


def _best_order(centres: Array, spec: BoardSpec) -> Array | None:
    """The order whose plane fits: right-handed, and for asymmetric grids with the offset rows in place."""
    grid = centres.reshape(spec.rows, spec.columns, 2)
    turns = (0, 1, 2, 3) if spec.columns == spec.rows and spec.kind is BoardKind.CIRCLES else (0, 2)
    points = board_points(spec)[:, :2]
    best, best_miss = None, np.inf
    for mirrored in (grid, grid[:, ::-1]):
        for turn in turns:
            candidate = np.rot90(mirrored, turn).reshape(-1, 2)
            found: Any = cv2.findHomography(points, candidate, 0)
            if (H := found[0]) is None or np.linalg.det(
                H[:2, :2] - np.outer(H[:2, 2], H[2, :2]) / H[2, 2]
            ) <= 0:
                continue
            miss = float(np.linalg.norm(through(H, points) - candidate, axis=1).max())
            # Equal fits are the turns that look the same: keep the first, so that the answer is stable.
            if miss < best_miss * 0.9:
                best, best_miss = candidate, miss
    return best
