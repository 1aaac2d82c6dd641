"""Boards of square markers: ChArUco and AprilGrid, also partly seen, and a single tag by its four sides."""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.corners import Grey, equalise, local_spacing, refine, sample, through
from calibrate.boards.model import board_points, dictionary_id, tag_dictionary
from recordings.geometry import Array
from recordings.schema.messages import BoardKind, BoardSpec

_FEW_MARKERS = 0.7
"""Share of the board's markers; where fewer are found, the image is brightened and enlarged."""
_SMALL_MARKER_PX, _ENLARGED, _LARGEST_SIDE_PX = 20.0, 3.0, 6000
"""Markers with shorter sides are read in an enlarged image, unless that would be larger than this."""
_SMALLEST_PERIMETER = 0.03
"""Perimeter of a marker over the longer side of the image; OpenCV's own."""
_ASTRAY, _MOST = 0.5, 0.75
"""A marker lies as printed if it is nearer to its place on the board than this share of its side: so much
because a lens shifts it, too. The second: share of the markers that must, else it is another board. With a
board in the other order (`legacy`) half of them do."""
_NEAR_SHARE, _FAR_MOVES = 0.025, 4.0
"""The sub-pixel search is not believed where it moves a corner from its prediction by more than this share of
the corners' spacing and by more than this multiple of the median move."""
Indices = NDArray[np.intp]
NOTHING = (np.zeros(0, dtype=np.intp), np.zeros((0, 2)))


@lru_cache(maxsize=8)
def charuco_board(spec: BoardSpec) -> Any:
    """Describe the board for OpenCV's detector."""
    dictionary = cv2.aruco.getPredefinedDictionary(dictionary_id(spec.dictionary or ""))
    board = cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_m, spec.marker_m or 0.0, dictionary)
    board.setLegacyPattern(spec.legacy)
    return board


def _printed(spec: BoardSpec) -> dict[int, Array]:
    """List the corners (4, 2) m of every marker of the board, clockwise from its top left."""
    if spec.kind is BoardKind.APRIL_GRID:  # Kalibr goes counter-clockwise from the bottom left
        return dict(enumerate(board_points(spec)[:, :2].reshape(-1, 4, 2)[:, ::-1]))
    board = charuco_board(spec)
    plane = np.array(board.getObjPoints(), float)[..., :2]
    return dict(zip(board.getIds().ravel().tolist(), plane, strict=True))


def find_charuco(grey: Grey, spec: BoardSpec, thorough: bool = True) -> tuple[Indices, Array]:
    """Find point indices (k,) and pixels (k, 2) of chessboard corners.

    `thorough`: where few markers are seen, the dark parts of the image are brightened; where those are
    small or none, it is enlarged.
    """
    printed, seen = _printed(spec), _at_a_glance(grey, spec)
    few = _FEW_MARKERS * len(printed)
    if thorough and len(seen) < few:
        seen = max(seen, _at_a_glance(equalise(grey), spec), key=len)
    small = not seen or _side_px(np.array(list(seen.values()))) < _SMALL_MARKER_PX
    if thorough and len(seen) < few and small and _ENLARGED * max(grey.shape) <= _LARGEST_SIDE_PX:
        large: Any = cv2.resize(grey, None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_CUBIC)
        detector = marker_detector(spec.dictionary or "", 1, _SMALLEST_PERIMETER / _ENLARGED)
        enlarged = _seen(detector, large, printed)
        seen = max(seen, {i: (marker + 0.5) / _ENLARGED - 0.5 for i, marker in enlarged.items()}, key=len)
    if len(seen) < 2 or (found := _as_printed(printed, seen)) is None:
        return NOTHING
    # OpenCV's sub-pixel step needs both markers of a corner; ours takes every corner the plane predicts.
    points = board_points(spec)[:, :2] + spec.square_m  # OpenCV counts from the outer edge
    H, tags = found
    plane, pixels = (np.concatenate([each[i] for i in tags]) for each in (printed, seen))
    return _snap_to_corners(grey, spec, H, plane, pixels, points)


def _seen(detector: Any, image: Any, known: Collection[int]) -> dict[int, Array]:
    """Number → corners (4, 2) px, clockwise from the top left, of each known marker that is seen once.

    One that is seen twice is on two boards, and nobody knows on which of them.
    """
    markers, ids, _ = detector.detectMarkers(image)
    numbers = [] if ids is None else ids.ravel().tolist()
    once = {i: np.asarray(m, float).reshape(4, 2) for i, m in zip(numbers, markers, strict=False)}
    return {i: marker for i, marker in once.items() if i in known and numbers.count(i) == 1}


def _side_px(markers: Array) -> float:
    """Median side of markers (n, 4, 2)."""
    return float(np.median(np.linalg.norm(np.diff(markers, axis=1), axis=2)))


def _as_printed(printed: dict[int, Array], seen: dict[int, Array]) -> tuple[Array, NDArray[np.intp]] | None:
    """(homography from the board, numbers of the markers that lie where it has them).

    A few may be misread, or not on the board. None where more are: it has other columns or rows.
    """
    plane, pixels = np.array([printed[i] for i in seen]), np.array(list(seen.values()))
    limit_px = _ASTRAY * _side_px(pixels)
    found: Any = cv2.findHomography(plane.reshape(-1, 2), pixels.reshape(-1, 2), cv2.RANSAC, limit_px)
    if (H := found[0]) is None:
        return None
    shown = through(H, plane.reshape(-1, 2)).reshape(pixels.shape)
    lies = np.linalg.norm(shown - pixels, axis=2).max(axis=1) < limit_px
    return (H, np.array(list(seen))[lies]) if lies.mean() >= _MOST else None


def _snap_to_corners(
    grey: Grey, spec: BoardSpec, H: Array, plane: Array, pixels: Array, points: Array
) -> tuple[Indices, Array]:
    """Predicts the chessboard corners from marker corners near them, refines, keeps what is a true saddle."""
    from_corner = np.linalg.norm(plane[None] - points[:, None], axis=-1)
    predicted = through(H, points)
    shown = through(H, plane)
    # The lens bends the plane: shift each prediction by what its nearest markers missed.
    weight = np.exp(-0.5 * (from_corner / spec.square_m) ** 2)
    known = weight.sum(axis=1) > 0.3
    miss = (weight @ (pixels - shown)) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    predicted += miss
    spacing = local_spacing(predicted.reshape(spec.rows - 1, spec.columns - 1, 2)).ravel()
    margin, last = np.maximum(spacing * 0.4, 4.0)[:, None], np.array(grey.shape[::-1]) - 1
    inside = ((predicted > margin) & (predicted < last - margin)).all(axis=1)
    chosen = np.flatnonzero(known & inside & (spacing > 5.0))
    if len(chosen) == 0:
        return NOTHING
    # No edge of a marker may come into the window: they run beside the corner, not through it.
    margin_share = 0.5 * (1.0 - (spec.marker_m or 0.0) / spec.square_m)
    across, down = (
        through(H, points[chosen] + half) - through(H, points[chosen] - half)
        for half in np.eye(2) * spec.square_m / 2
    )
    # A tilt about the diagonal brings the markers' corners nearer than any neighbour.
    diagonals = [np.linalg.norm(d, axis=1) / np.sqrt(2) for d in (across + down, across - down)]
    room = np.minimum.reduce([spacing[chosen], *diagonals])
    corners = refine(grey, predicted[chosen], min(0.8, 2.8 * margin_share) * room)
    radius = (np.clip(min(0.25, 1.2 * margin_share) * room, 2.0, 12.0) / room)[:, None]
    good = is_saddle(grey, corners, radius * across, radius * down)
    moved = np.linalg.norm(corners - predicted[chosen], axis=1)
    if good.any():
        good &= moved <= np.maximum(_NEAR_SHARE * room, _FAR_MOVES * np.median(moved[good]))
    return chosen[good], corners[good]


def is_saddle(grey: Grey, corners: Array, across: Array, down: Array) -> NDArray[np.bool_]:
    """Tell chessboard corners: round them bright and dark alternate twice, opposite sides alike.

    corners, across, down: (n, 2); the ring is a circle on the board, and these its half axes in the image.
    """
    angles = np.arange(16) * (2 * np.pi / 16)
    circle = np.cos(angles)[:, None] * across[:, None] + np.sin(angles)[:, None] * down[:, None]
    ring = sample(grey, corners[:, None] + circle)
    ring -= ring.mean(axis=1, keepdims=True)
    spectrum = np.abs(np.fft.rfft(ring, axis=1)) ** 2
    share = spectrum[:, 2] / np.maximum(spectrum[:, 1:].sum(axis=1), 1e-9)
    return np.asarray((share > 0.6) & (ring.std(axis=1) > 4.0))


@lru_cache(maxsize=8)
def marker_detector(
    dictionary: str,
    border_bits: int,
    smallest: float = _SMALLEST_PERIMETER,
    refinement: int = cv2.aruco.CORNER_REFINE_SUBPIX,
) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = smallest
    parameters.markerBorderBits = border_bits
    parameters.cornerRefinementMethod = refinement
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary_id(dictionary)), parameters)


def find_april_grid(grey: Grey, spec: BoardSpec) -> tuple[Indices, Array]:
    """Find four corners of every tag. Printed borders of one and of two bits (Kalibr) are tried."""
    seen = _at_a_glance(grey, spec)
    if not seen or (found := _as_printed(_printed(spec), seen)) is None:
        return NOTHING
    tags = found[1]
    pixels = np.array([seen[i] for i in tags])
    sides = np.repeat(np.linalg.norm(np.diff(pixels, axis=1), axis=2).min(axis=1), 4)
    gap_share = (spec.marker_m or spec.square_m) / spec.square_m
    refined = refine(grey, pixels[:, ::-1].reshape(-1, 2), sides * min(1.0, gap_share))
    return (4 * tags[:, None] + np.arange(4)).ravel(), refined


def _at_a_glance(grey: Grey, spec: BoardSpec) -> dict[int, Array]:
    """Corners (4, 2) px of the board's markers that are seen at once."""
    borders = (2, 1) if spec.kind is BoardKind.APRIL_GRID else (1,)
    detectors = (marker_detector(tag_dictionary(spec), border_bits) for border_bits in borders)
    return max((_seen(detector, grey, _printed(spec)) for detector in detectors), key=len)


_ROW_BY_ROW = [0, 1, 3, 2]
"""OpenCV goes clockwise from the top left."""
_SMOOTHING_PX, _STEP_PX = 0.7, 0.25
_SIDE_FROM, _SIDE_TO = 0.1, 0.9
"""Part of a side that is fitted: the corners are rounded by blur."""
_REACH_SHARE, _LEAST_REACH_PX, _MOST_REACH_PX = 1 / 16, 2.0, 6.0
"""Search range about the expected side; less than half a cell of any dictionary's tag."""
_FAINT = 0.5
"""Share of the median contrast along a side; fainter places are left out."""
_FAR_MADS, _FAR_PX = 4.5, 0.05
_FIT_ROUNDS = 3
_BENT_PX = 60.0
"""The lens bends a longer side by more than its fit errs: a parabola instead of a line."""


def find_tag(grey: Grey, spec: BoardSpec, thorough: bool = True) -> tuple[Indices, Array]:
    """Find point indices (4,) and pixels (4, 2) of the tag's corners, or none of either.

    `thorough`: where it is not seen, the dark parts of the image are brightened.
    """
    quick = marker_detector(tag_dictionary(spec), 1)
    # AprilTag's search for quadrilaterals: slower, finds what OpenCV's leaves out (8 of 55 rendered). Its
    # corners are half a pixel off; the fit of the sides mends that.
    other = marker_detector(tag_dictionary(spec), 1, refinement=cv2.aruco.CORNER_REFINE_APRILTAG)
    attempts = [(quick, grey), (other, grey)]
    if thorough:
        attempts.append((other, equalise(grey)))
    for detector, image in attempts:
        markers, ids, _ = detector.detectMarkers(image)
        tags = (
            [] if ids is None else [np.asarray(markers[k], float) for k in np.flatnonzero(ids == spec.tag_id)]
        )
        if len(tags) == 1:
            return np.arange(4), fit_sides(grey, tags[0].reshape(4, 2))[_ROW_BY_ROW]
        if tags:  # on two boards, and nobody knows which is meant
            break
    return NOTHING


def fit_sides(grey: Grey, corners: Array) -> Array:
    """Fit corners (4, 2) in order round the tag, each where its two sides meet.

    A corner of an outline is no saddle: smoothing pulls it inwards, which sub-pixel search follows.
    """
    smooth: Any = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SMOOTHING_PX)
    sides = [_fit_side(smooth, corners[k], corners[(k + 1) % 4]) for k in range(4)]
    refined = corners.copy()
    for k in range(4):
        (_, (before, normal_before)), ((after, normal_after), _) = sides[k - 1], sides[k]
        normals = np.stack([normal_before, normal_after])
        if abs(np.linalg.det(normals)) > 1e-3:
            refined[k] = np.linalg.solve(normals, [normal_before @ before, normal_after @ after])
    ran = np.linalg.norm(refined - corners, axis=1) > _MOST_REACH_PX
    refined[ran] = corners[ran]
    return refined


def _fit_side(smooth: Any, first: Array, last: Array) -> list[tuple[Array, Array]]:
    """The side's curve at its first and at its last corner: a point and the normal of the tangent.

    The edge lies in the middle of the step of grey, sought across the side at many places along it.
    """
    length = float(np.linalg.norm(last - first))
    across = np.array([first[1] - last[1], last[0] - first[0]]) / max(length, 1e-9)
    reach = float(np.clip(_REACH_SHARE * length, _LEAST_REACH_PX, _MOST_REACH_PX))
    offsets = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    share = np.linspace(_SIDE_FROM, _SIDE_TO, max(8, int(length)))
    along = first + share[:, None] * (last - first)
    places = (along[:, None] + offsets[:, None] * across).astype(np.float32)
    values = cv2.remap(
        smooth, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    step = np.diff(np.asarray(values, dtype=float), axis=1)
    step = np.clip(step * np.sign(step.sum()), 0.0, None)
    contrast = step.sum(axis=1)
    middle = (step * (offsets[1:] + offsets[:-1]) / 2).sum(axis=1) / np.maximum(contrast, 1e-9)
    curve = _fit_curve(share, middle, contrast > _FAINT * np.median(contrast), 2 if length > _BENT_PX else 1)
    ends = []
    for at in (0.0, 1.0):
        slope = float(curve.deriv()(at)) / max(length, 1e-9)
        normal = across - slope * (last - first) / max(length, 1e-9)
        ends.append((first + at * (last - first) + float(curve(at)) * across, normal))
    return ends


def _fit_curve(share: Array, offset: Array, kept: NDArray[np.bool_], degree: int) -> np.polynomial.Polynomial:
    """Least squares, far points left out."""
    curve = np.polynomial.Polynomial([0.0])
    for _ in range(_FIT_ROUNDS):
        if kept.sum() <= 2 * degree:
            break
        curve = np.polynomial.Polynomial.fit(share[kept], offset[kept], degree)
        miss = np.abs(offset - curve(share))
        kept = kept & (miss <= max(_FAR_MADS * float(np.median(miss[kept])), _FAR_PX))
    return curve
