"""Chessboard corners: several detectors, the quick one first, each checked for regularity."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import msgspec
import numpy as np

from calibrate.boards.corners import (
    Grey,
    equalise,
    is_regular,
    local_spacing,
    refine,
    right_handed,
    square_contrast,
    square_means,
)
from calibrate.boards.model import looks_same_turns
from calibrate.geometry import Array
from recordings.schema.messages import BoardSpec

_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_LARGE_SIDE_PX = 1000
_SMALL_SIDE_PX = 800
_PREVIEW_SIDE_PX = 640


def find_chessboard(grey: Grey, spec: BoardSpec, thorough: bool = True) -> Array | None:
    """All inner corners in board order, (rows·columns, 2) pixels, or None.

    The colours of the squares decide the orientation where they can; otherwise the order is one of the turns
    after which the board looks the same. `thorough=False` makes one quick attempt on a smaller picture.
    """
    for found in _attempts(grey, (spec.columns, spec.rows), thorough):
        if found is None:
            continue
        grid = right_handed(found.reshape(spec.rows, spec.columns, 2).astype(float))
        spacing = local_spacing(grid)
        if spacing.min() < 3.0:
            continue
        flat = refine(grey, grid.reshape(-1, 2), spacing.ravel())
        grid = flat.reshape(grid.shape)
        if is_regular(grid):
            return _orient(grey, grid, spec).reshape(-1, 2)
    return None


def _attempts(grey: Grey, size: tuple[int, int], thorough: bool) -> Iterator[Array | None]:
    largest = max(grey.shape)
    if not thorough:
        yield _scaled(grey, min(1.0, _PREVIEW_SIDE_PX / largest), lambda small: _classic(small, size))
        return
    if largest > _LARGE_SIDE_PX:
        yield _scaled(grey, 0.5, lambda small: _classic(small, size))  # a third of the time
    yield _classic(grey, size)
    yield _sector(grey, size, 0)
    equalised = equalise(grey)
    yield _classic(equalised, size)
    yield _sector(equalised, size, cv2.CALIB_CB_EXHAUSTIVE)
    if largest <= _SMALL_SIDE_PX:
        yield _scaled(grey, 2.0, lambda large: _classic(large, size))


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
    # Among the turns that the colours allow, the first corner nearest the picture's top left.
    means, grey_level = square_means(grey, grid), float(cv2.mean(grey)[0])
    dark_first = [t for t in turns if square_contrast(np.rot90(means, t), grey_level) > 0] or turns
    return min((np.rot90(grid, t) for t in dark_first), key=lambda c: float(c[0, 0].sum()))


def other_size(grey: Grey, spec: BoardSpec) -> tuple[int, int] | None:
    """Inner corners (columns, rows) of a chessboard that is seen where that of `spec` is not; None: none is.

    One smaller each way is looked for by name: that is what a board looks like whose squares were counted.
    """
    seen = seen_size(grey)
    if seen is None or min(spec.columns, spec.rows) < 3:
        return seen
    smaller = msgspec.structs.replace(spec, columns=spec.columns - 1, rows=spec.rows - 1)
    found = find_chessboard(grey, smaller) is not None
    return (smaller.columns, smaller.rows) if found else seen


def seen_size(grey: Grey) -> tuple[int, int] | None:
    """Sides in corners, the longer first, of whatever chessboard is there: a wrong one may be used."""
    factor = min(1.0, _LARGE_SIDE_PX / max(grey.shape))
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    found, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), cv2.CALIB_CB_LARGER)
    return (max(meta.shape), min(meta.shape)) if found else None
