"""A single ArUco or AprilTag: found by its code, its corners from curves fitted to its four sides."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.corners import Grey, equalise
from calibrate.boards.markers import NOTHING, Indices, marker_detector
from calibrate.boards.model import dictionary_id, tag_dictionary
from calibrate.geometry import Array
from recordings.schema.messages import BoardSpec

_ROW_BY_ROW = [0, 1, 3, 2]
"""OpenCV goes clockwise from the top left."""
_SMOOTHING_PX, _STEP_PX = 0.7, 0.25
_SIDE_FROM, _SIDE_TO = 0.1, 0.9
"""Part of a side that is fitted: the corners are rounded by blur."""
_REACH_SHARE, _LEAST_REACH_PX, _MOST_REACH_PX = 1 / 16, 2.0, 6.0
"""How far from the expected side the edge is sought; less than half a cell of any dictionary's tag."""
_FAINT = 0.5
"""Of the median contrast along a side; fainter places are left out."""
_FAR_MADS, _FAR_PX = 4.5, 0.05
_FIT_ROUNDS = 3
_BENT_PX = 60.0
"""The lens bends a longer side by more than its fit errs: a parabola instead of a line."""


def find_tag(grey: Grey, spec: BoardSpec, thorough: bool = True) -> tuple[Indices, Array]:
    """Point indices (4,) and pixels (4, 2) of the tag's corners, or none of either.

    `thorough`: where it is not seen, the dark parts of the picture are brightened.
    """
    quick, other = (marker_detector(tag_dictionary(spec), 1), _quad_detector(tag_dictionary(spec)))
    attempts = [(quick, grey), (other, grey)]
    if thorough:
        attempts.append((other, equalise(grey)))
    corners = next(
        (seen for each, picture in attempts if (seen := _seen(each, picture, spec)) is not None), None
    )
    if corners is None:
        return NOTHING
    return np.arange(4), fit_sides(grey, corners)[_ROW_BY_ROW]


@lru_cache(maxsize=8)
def _quad_detector(dictionary: str) -> Any:
    """AprilTag's search for quadrilaterals: slower, finds what OpenCV's leaves out (8 of 55 rendered).

    Its corners are half a pixel off; the fit of the sides mends that.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary_id(dictionary)), parameters)


def _seen(detector: Any, grey: Grey, spec: BoardSpec) -> Array | None:
    """(4, 2) clockwise; None also where two tags carry the number: nobody knows which is the board."""
    markers, ids, _ = detector.detectMarkers(grey)
    numbers = [] if ids is None else ids.ravel().tolist()
    if numbers.count(spec.tag_id) != 1:
        return None
    return np.asarray(markers[numbers.index(spec.tag_id)].reshape(4, 2), dtype=float)


def fit_sides(grey: Grey, corners: Array) -> Array:
    """Corners (4, 2) in order round the tag, each where its two sides meet.

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
