"""Intrinsics from the session's own images (Zhang): where the estimate of everything starts.

Z. Zhang, "A flexible new technique for camera calibration" (2000), for all lens models: `fit_lens` finds lens
and board poses together by least squares over the corners. What the images leave open stays where the prior
puts it (`handeye.priors`), so no parameter has to be held.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import msgspec
import numpy as np

from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.handeye.corner_fit import fit_corners
from calibrate.handeye.priors import LensPrior
from calibrate.lens.pnp import planar_tilts
from calibrate.views.projection import camera_matrix
from calibrate.views.view_set import ViewSet, observe_views
from recordings.geometry import Array
from recordings.schema.messages import CameraModel

LensModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

FEWEST_FOR_INTRINSICS = 3
_FISHEYE_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-9)


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Estimated intrinsics."""

    camera: CameraModel
    rms_px: float
    """RMS of the corners' distances from where the lens shows them; without dropped views."""
    dropped: dict[int, str] = field(default_factory=dict)
    """Pose number → why its corners were left out of the fit."""


def calibrate_intrinsics(views: ViewSet, model: LensModel = "plumb_bob") -> Intrinsics:
    """Fit the lens to all views, leaving out those four times worse than the median until there is none.

    Raises TooFewViewsError below three views, BadViewsError when no lens explains the corners.
    """
    if len(views) < FEWEST_FOR_INTRINSICS:
        raise TooFewViewsError(
            counted=f"{len(views)} views to find the intrinsics",
            views=len(views),
            needed=FEWEST_FOR_INTRINSICS,
            advice="Give the camera's matrix and distortion, or record more views with different tilts.",
        )
    dropped: dict[int, str] = {}
    used = views
    while True:
        try:
            lens, view_rms_px = _fit(used, model)
        except (cv2.error, np.linalg.LinAlgError) as problem:
            reason = problem.err if isinstance(problem, cv2.error) else problem
            raise BadViewsError("intrinsics-open", reason=str(reason)) from None
        median_px = float(np.median(view_rms_px))
        good = np.flatnonzero(view_rms_px <= max(4 * median_px, 0.5)).tolist()
        if len(good) == len(used) or len(good) < FEWEST_FOR_INTRINSICS:
            break
        for k in set(range(len(used))) - set(good):
            fits = f"its corners fit the lens to {view_rms_px[k]:.2f} px, the median is {median_px:.2f} px"
            dropped[used.views[k].index] = fits
        used = used.select(good)
    side, K = max(views.camera.width, views.camera.height), camera_matrix(lens)
    rms_px = float(np.sqrt(np.average(view_rms_px**2, weights=[len(view.corners) for view in used])))
    if not (0.2 * side < K[0, 0] < 100 * side and rms_px <= 0.01 * side):
        raise BadViewsError(
            "no-lens-fits",
            reason=f"focal length {K[0, 0]:.0f} px, rms {rms_px:.1f} px",
            focal_px=float(K[0, 0]),
            rms_px=rms_px,
        )
    return Intrinsics(lens, rms_px, dropped)


def _fit(views: ViewSet, model: LensModel) -> tuple[CameraModel, Array]:
    if model == "equidistant":
        return fit_lens(views, _first_fisheye(views))
    lens, view_rms_px = fit_lens(views, initial_camera(views))
    if model == "plumb_bob":
        return lens, view_rms_px
    bent = (*lens.distortion, 0.0, 0.0, 0.0)
    return fit_lens(views, msgspec.structs.replace(lens, distortion=bent, distortion_model=model))


def _first_fisheye(views: ViewSet) -> CameraModel:
    """Start from OpenCV, which copes with boards at the edge of a wide image."""
    object_points = [v.corners.points.reshape(-1, 1, 3) for v in views]
    pixels = [v.corners.pixels.reshape(-1, 1, 2) for v in views]
    flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
    size = (views.camera.width, views.camera.height)
    try:
        _, K, D, _, _ = cv2.fisheye.calibrate(
            object_points, pixels, size, np.eye(3), np.zeros(4), flags=flags, criteria=_FISHEYE_STEPS
        )
    except cv2.error as problem:
        raise BadViewsError("no-lens-fits", reason=f"fisheye: {problem.err}") from None
    matrix: Any = tuple(tuple(float(v) for v in row) for row in np.asarray(K))
    return CameraModel(*size, matrix, tuple(float(v) for v in np.asarray(D).ravel()), "equidistant")


def fit_lens(views: ViewSet, start: CameraModel) -> tuple[CameraModel, Array]:
    """Fit from an initial lens: the lens, and the rms distance of each view's corners from it (n,), px.

    Raises BadViewsError or cv2.error where the corners allow no fit.
    """
    C = np.array([planar_tilts(view, start)[0] for view in views])
    found = fit_corners(observe_views(views), start, C, LensPrior.unknown(start))
    return found.camera, found.rms_px


def initial_camera(views: ViewSet) -> CameraModel:
    """Guess the focal length from the boards' shapes in the images; centre in the middle, no distortion."""
    size = (views.camera.width, views.camera.height)
    points = [view.corners.points.astype(np.float32) for view in views]
    pixels = [view.corners.pixels.astype(np.float32) for view in views]
    K = np.asarray(cv2.initCameraMatrix2D(points, pixels, size, 0), dtype=float)
    focal = np.where(np.isfinite(K[[0, 1], [0, 1]]), K[[0, 1], [0, 1]], max(size))
    focal = np.clip(focal, 0.1 * max(size), 100 * max(size))
    matrix = ((float(focal[0]), 0.0, (size[0] - 1) / 2), (0.0, float(focal[1]), (size[1] - 1) / 2))
    return CameraModel(*size, (*matrix, (0.0, 0.0, 1.0)), (0.0,) * 5)
