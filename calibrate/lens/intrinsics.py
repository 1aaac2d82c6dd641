"""The lens, found from the session's own pictures (Zhang): where the estimate of everything starts.

Z. Zhang, "A flexible new technique for camera calibration" (2000), for all lens models by `lens_fit`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import msgspec
import numpy as np

from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.lens.fit import LensFit, first_guess, fit_lens
from calibrate.projection import camera_matrix, intrinsics_names
from calibrate.views import ViewSet
from recordings.schema.messages import CameraModel

LensModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

FEWEST_VIEWS = 3
_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-9)


@dataclass(frozen=True, eq=False)
class Intrinsics:
    camera: CameraModel
    rms_px: float
    """Of the corners' distances from where the lens shows them; without dropped views."""
    view_rms_px: dict[int, float]
    """Pose number → rms over its corners."""
    sigma: dict[str, float]
    """1σ of each parameter by the pictures alone: fx fy cx cy in pixels, the others plain."""
    dropped: dict[int, str] = field(default_factory=dict)
    """Pose number → why its corners were left out of the fit."""


def calibrate_intrinsics(views: ViewSet, model: LensModel = "plumb_bob") -> Intrinsics:
    """Fits the lens to all views, leaving out those four times worse than the median until there is none.

    Raises TooFewViewsError below three views, BadViewsError when no lens explains the corners.
    """
    if len(views) < FEWEST_VIEWS:
        raise TooFewViewsError(
            f"The lens cannot be found from {len(views)} view(s): at least {FEWEST_VIEWS} with different "
            "tilts are needed. Give the camera's matrix and distortion, or take more pictures."
        )
    dropped: dict[int, str] = {}
    used = views
    while True:
        try:
            fit = _fit(used, model)
        except (cv2.error, np.linalg.LinAlgError) as problem:
            reason = problem.err if isinstance(problem, cv2.error) else problem
            raise BadViewsError(
                f"The lens cannot be found from these corners ({reason}). Check the board's size."
            ) from None
        limit = max(4 * float(np.median(fit.view_rms_px)), 0.5)
        good = [k for k in range(len(used)) if fit.view_rms_px[k] <= limit]
        if len(good) == len(used) or len(good) < FEWEST_VIEWS:
            break
        for k in set(range(len(used))) - set(good):
            dropped[used.views[k].index] = (
                f"its corners fit the lens to {fit.view_rms_px[k]:.2f} px, the median is "
                f"{float(np.median(fit.view_rms_px)):.2f} px"
            )
        used = used.select(good)
    size, K = (views.camera.width, views.camera.height), camera_matrix(fit.camera)
    if not (0.2 * max(size) < K[0, 0] < 100 * max(size) and fit.rms_px <= 0.01 * max(size)):
        raise BadViewsError(
            f"No lens explains the corners (focal length {K[0, 0]:.0f} px, rms {fit.rms_px:.1f} px). "
            "Check the board's columns and rows, or give the camera's matrix. Pictures that all face the "
            "board squarely do not determine a lens: tilt the camera by 20° to 40°."
        )
    return Intrinsics(
        fit.camera,
        fit.rms_px,
        {view.index: float(rms) for view, rms in zip(used, fit.view_rms_px, strict=True)},
        dict(zip(intrinsics_names(fit.camera), np.sqrt(np.diag(fit.covariance)).tolist(), strict=True)),
        dropped,
    )


def _fit(views: ViewSet, model: LensModel) -> LensFit:
    if model == "equidistant":
        return fit_lens(views, _first_fisheye(views))
    fit = fit_lens(views, first_guess(views))
    if model == "plumb_bob":
        return fit
    start = msgspec.structs.replace(
        fit.camera, distortion=(*fit.camera.distortion, 0.0, 0.0, 0.0), distortion_model=model
    )
    return fit_lens(views, start)


def _first_fisheye(views: ViewSet) -> CameraModel:
    """By OpenCV, whose start copes with boards at the edge of a wide picture."""
    object_points = [v.board_points.reshape(-1, 1, 3) for v in views]
    pixels = [v.pixels.reshape(-1, 1, 2) for v in views]
    flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
    size = (views.camera.width, views.camera.height)
    try:
        _, K, D, _, _ = cv2.fisheye.calibrate(
            object_points, pixels, size, np.eye(3), np.zeros(4), flags=flags, criteria=_STEPS
        )
    except cv2.error as problem:
        raise BadViewsError(
            f"No fisheye lens explains the corners ({problem.err}). Try plumb_bob, or more tilted views."
        ) from None
    matrix: Any = tuple(tuple(float(v) for v in row) for row in np.asarray(K))
    return CameraModel(*size, matrix, tuple(float(v) for v in np.asarray(D).ravel()), "equidistant")
