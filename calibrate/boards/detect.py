"""One image in, the board's points out; says why when there are none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.corners import Grey, to_grey
from calibrate.boards.grids import find_chessboard, find_circles, other_size
from calibrate.boards.markers import NOTHING, find_april_grid, find_charuco, find_tag
from calibrate.boards.model import board_points, check_board, describe_board, fixes_a_plane
from calibrate.views.corners import Corners
from recordings.files import MAIN_CAMERA
from recordings.geometry import Array
from recordings.images import Pixels
from recordings.schema.messages import SINGLE_TAGS, BoardKind, BoardSpec

FEWEST_POINTS = 6
"""Fewer corners of a partial board do not give a trustworthy pose."""
_SATURATED_GREY = 252
Cause = Literal[
    "",
    "not-found",
    "in-line",
    "few-corners",
    "too-dark",
    "over-exposed",
    "empty",
    "other-board",
    "squares-counted",
    "mirrored",
]
"""squares-counted: a chessboard one smaller each way is seen; mirrored: markers in the mirror image only."""


@dataclass(frozen=True, eq=False)
class Detection:
    """The board as one image shows it."""

    cause: Cause
    """Cause for a program; empty when the board was found."""
    reason: str
    """The cause for people."""
    corners: Corners
    """Those found, in pixels of this image; none where the board was not found."""
    expected: int
    """Points of the whole board."""
    width: int
    height: int
    saturated: float
    """Share of pixels at the upper end of the scale on the board (whole image if none), 0 … 1."""
    coverage: float
    """Share of the image inside the outline of the points, 0 … 1."""

    @property
    def found(self) -> bool:
        return not self.cause


def detect(
    image: Pixels,
    spec: BoardSpec,
    thorough: bool = True,
    exhaustive: bool = True,
    camera: str = MAIN_CAMERA,
) -> Detection:
    """Find the board to sub-pixel accuracy.

    image: (h, w) uint8 or uint16, or (h, w, 3) BGR. `thorough=False` leaves out the slow attempts and the
    search for the reason (previews), `exhaustive=False` the slowest and that search. `camera`: name of the
    one that took the image. Raises BoardError for an impossible board; an image without a board is an answer,
    not an error.
    """
    check_board(spec)
    grey = to_grey(image)
    points = board_points(spec)
    expected = len(points)
    height, width = grey.shape
    indices, pixels = _find(grey, spec, thorough, exhaustive)
    fewest = min(FEWEST_POINTS, expected)
    whole = len(indices) == expected
    found = whole or (len(indices) >= fewest and fixes_a_plane(points[indices]))
    cause: Cause
    cause, reason = ("", "") if found else _reason(grey, spec, len(indices), fewest, thorough and exhaustive)
    if not found:
        indices, pixels = indices[:0], pixels[:0]
    area = cv2.contourArea(cv2.convexHull(pixels.astype(np.float32))) if found else 0.0
    share = area / (width * height)
    corners = Corners(points[indices], pixels, indices, camera=camera)
    return Detection(cause, reason, corners, expected, width, height, _saturated(grey, pixels), share)


def _find(
    grey: Grey, spec: BoardSpec, thorough: bool, exhaustive: bool = True
) -> tuple[NDArray[np.intp], Array]:
    if spec.kind is BoardKind.CHARUCO:
        return find_charuco(grey, spec, thorough)
    if spec.kind is BoardKind.APRIL_GRID:
        return find_april_grid(grey, spec)
    if spec.kind in SINGLE_TAGS:
        return find_tag(grey, spec, thorough)
    if spec.kind is BoardKind.CHESSBOARD:
        pixels = find_chessboard(grey, spec, thorough, exhaustive)
    else:
        pixels = find_circles(grey, spec)
    if pixels is None:
        return NOTHING
    return np.arange(len(pixels)), pixels


def _reason(grey: Grey, spec: BoardSpec, count: int, fewest: int, thorough: bool) -> tuple[Cause, str]:
    if thorough and _seen_in_a_mirror(grey, spec):
        return "mirrored", "only the mirror image shows the board: the camera or its driver mirrors images"
    if count >= fewest:
        return "in-line", f"the {count} corners of the board that are seen lie in a line: they fix no pose"
    if count:
        return "few-corners", f"{count} corners of the board are seen (minimum {fewest})"
    level = float(grey.mean())
    if level < 12.0:
        return "too-dark", f"the image is dark (mean grey {level:.0f}): lens covered, or light off"
    if float((grey >= _SATURATED_GREY).mean()) > 0.5:
        return "over-exposed", "the image is over-exposed: more than half of it is saturated"
    if float(grey.std()) < 3.0:
        return "empty", f"the image is empty (grey {level:.0f}, no contrast)"
    seen = other_size(grey, spec) if thorough and spec.kind is BoardKind.CHESSBOARD else None
    if seen is None or sorted(seen) == sorted((spec.columns, spec.rows)):
        return "not-found", f"no {describe_board(spec)} found"
    text = f"board {spec.columns}×{spec.rows} expected, {seen[0]}×{seen[1]} seen (inner corners)"
    if seen == (spec.columns - 1, spec.rows - 1):
        return "squares-counted", f"{text}: squares were counted, or a row and a column are hidden"
    return "other-board", f"{text}: partly hidden, or another board"


def _seen_in_a_mirror(grey: Grey, spec: BoardSpec) -> bool:
    """Only markers tell: a chessboard looks right in a mirror."""
    if spec.kind not in (BoardKind.CHARUCO, BoardKind.APRIL_GRID, *SINGLE_TAGS):
        return False
    indices, _ = _find(np.ascontiguousarray(grey[:, ::-1]), spec, thorough=False)
    return len(indices) >= min(FEWEST_POINTS, len(board_points(spec)))


def _saturated(grey: Grey, pixels: Array) -> float:
    region = grey
    if len(pixels):
        x0, y0 = np.maximum(np.floor(pixels.min(axis=0)).astype(int), 0)
        x1, y1 = np.ceil(pixels.max(axis=0)).astype(int) + 1
        region = grey[y0:y1, x0:x1]
    return cv2.countNonZero(cv2.inRange(region, _SATURATED_GREY, 255)) / region.size
