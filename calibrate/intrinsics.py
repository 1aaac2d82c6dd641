"""The lens, found from the session's own pictures (Zhang), holding what the pictures cannot tell.

Z. Zhang, "A flexible new technique for camera calibration" (2000), by OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np

from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.geometry import Array
from calibrate.projection import INTRINSICS
from calibrate.views import ViewSet
from recordings.messages import CameraModel

LensModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

FEWEST_VIEWS = 3
_SIGNIFICANT_SIGMAS = 2.0
_LARGEST_BEND_PX = 1.0
_LARGEST_CENTRE_SIGMA_SHARE = 0.03
_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-9)
_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, eq=False)
class Intrinsics:
    camera: CameraModel
    rms_px: float
    view_rms_px: dict[int, float]
    """Pose number → rms over its corners."""
    sigma: dict[str, float]
    """1σ of each parameter that was fitted: fx fy cx cy in pixels, the others plain."""
    held: tuple[str, ...] = ()
    """Sentences: which parameters were held, and why."""
    dropped: dict[int, str] = field(default_factory=dict)
    """Pose number → why its corners were left out of the fit."""

    @property
    def held_names(self) -> tuple[str, ...]:
        """Which of `projection.INTRINSICS` were held (plumb-bob)."""
        return tuple(name for name in INTRINSICS if name not in self.sigma)


@dataclass
class _Fit:
    flags: int
    rms_px: float
    K: Array
    D: Array
    sigma: Array
    per_view: Array


def calibrate_intrinsics(views: ViewSet, model: LensModel = "plumb_bob") -> Intrinsics:
    """Fits the lens to all views; a view that fits four times worse than the median is left out.

    Raises TooFewViewsError below three views, BadViewsError when no lens explains the corners.
    """
    if len(views) < FEWEST_VIEWS:
        raise TooFewViewsError(
            f"The lens cannot be found from {len(views)} view(s): at least {FEWEST_VIEWS} with different "
            "tilts are needed. Give the camera's matrix and distortion, or take more pictures."
        )
    dropped: dict[int, str] = {}
    used = views
    for _ in range(3):
        fit, held = _fit_model(used, model)
        limit = max(4 * float(np.median(fit.per_view)), 0.5)
        good = [k for k in range(len(used)) if fit.per_view[k] <= limit]
        if len(good) == len(used) or len(good) < FEWEST_VIEWS:
            break
        for k in set(range(len(used))) - set(good):
            dropped[used.views[k].index] = (
                f"its corners fit the lens to {fit.per_view[k]:.2f} px, the median is "
                f"{float(np.median(fit.per_view)):.2f} px"
            )
        used = used.select(good)
    size = (views.camera.width, views.camera.height)
    if not (0.2 * max(size) < fit.K[0, 0] < 100 * max(size)) or fit.rms_px > 0.01 * max(size):
        raise BadViewsError(
            f"No lens explains the corners (focal length {fit.K[0, 0]:.0f} px, rms {fit.rms_px:.1f} px). "
            "Check the board's columns and rows, or give the camera's matrix. Pictures that all face the "
            "board squarely do not determine a lens: tilt the camera by 20° to 40°."
        )
    return Intrinsics(
        CameraModel(
            width=size[0],
            height=size[1],
            matrix=tuple(tuple(float(v) for v in row) for row in fit.K),  # type: ignore[misc]
            distortion=tuple(float(v) for v in fit.D),
            distortion_model=model,
        ),
        fit.rms_px,
        {view.index: float(rms) for view, rms in zip(used, fit.per_view, strict=True)},
        {name: float(s) for name, s in zip(_NAMES, fit.sigma, strict=False) if s > 0},
        held,
        dropped,
    )


def _fit_model(views: ViewSet, model: LensModel) -> tuple[_Fit, tuple[str, ...]]:
    if model == "equidistant":
        return _fit_fisheye(views), ()
    flags = cv2.CALIB_RATIONAL_MODEL if model == "rational_polynomial" else 0
    fit = _fit(views, flags)
    held: list[str] = []
    while (more := _undetermined(fit, views.camera)) is not None:
        flag, text = more
        held.append(text)
        fit = _fit(views, fit.flags | flag)
    return fit, tuple(held)


def _fit(views: ViewSet, flags: int) -> _Fit:
    object_points = [v.board_points.astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32) for v in views]
    size = (views.camera.width, views.camera.height)
    before = cv2.getNumThreads()
    # OpenCV's threads sum in the order they finish: the last bits would differ from run to run.
    cv2.setNumThreads(1)
    try:
        unknown: Any = None
        rms, K, D, _, _, sigma, _, per_view = cv2.calibrateCameraExtended(
            object_points, pixels, size, unknown, unknown, flags=flags | cv2.CALIB_USE_LU, criteria=_STEPS
        )
    except cv2.error as problem:
        raise BadViewsError(
            f"The lens cannot be found from these corners ({problem.err}). Check the board's size."
        ) from None
    finally:
        cv2.setNumThreads(before)
    count = 8 if flags & cv2.CALIB_RATIONAL_MODEL else 5
    return _Fit(
        flags, float(rms), _floats(K), _floats(D)[:count], _floats(sigma)[: 4 + count], _floats(per_view)
    )


def _floats(values: Any) -> Array:
    found = np.asarray(values, dtype=np.float64)
    return found if found.shape == (3, 3) else found.ravel()


def _undetermined(fit: _Fit, camera: CameraModel) -> tuple[int, str] | None:
    """The next parameter to hold: (OpenCV's flag, sentence), or None when all are determined."""
    k1, k2, p1, p2, k3 = fit.D[:5]
    s = fit.sigma
    rational = bool(fit.flags & cv2.CALIB_RATIONAL_MODEL)
    centre, focal = fit.K[:2, 2], float(fit.K[0, 0])
    corner = float(np.linalg.norm(np.maximum(centre, [camera.width, camera.height] - centre))) / focal

    def unknown(power: int, value: float, sigma: float) -> bool:
        """Not told from zero, and left free it could bend the picture's corner by more than a pixel.

        A value that would throw the corner out of the picture comes from a singular fit, whatever its sigma.
        """
        bend_px, doubt_px = focal * abs(value) * corner**power, focal * sigma * corner**power
        if bend_px > max(camera.width, camera.height):
            return True
        return abs(value) < _SIGNIFICANT_SIGMAS * sigma and doubt_px > _LARGEST_BEND_PX

    if not fit.flags & cv2.CALIB_FIX_PRINCIPAL_POINT and max(s[2], s[3]) > (
        _LARGEST_CENTRE_SIGMA_SHARE * max(camera.width, camera.height)
    ):
        return (
            cv2.CALIB_FIX_PRINCIPAL_POINT,
            f"principal point held at the centre: the views know it only to {max(s[2], s[3]):.0f} px",
        )
    if rational:
        return None
    if not fit.flags & cv2.CALIB_FIX_K3 and unknown(7, k3, s[8]):
        return cv2.CALIB_FIX_K3, f"k3 held at 0: found {k3:.3g} ± {s[8]:.2g}"
    if not fit.flags & cv2.CALIB_ZERO_TANGENT_DIST and unknown(2, p1, s[6]) and unknown(2, p2, s[7]):
        return (
            cv2.CALIB_ZERO_TANGENT_DIST,
            f"p1, p2 held at 0: found {p1:.2g} ± {s[6]:.1g}, {p2:.2g} ± {s[7]:.1g}",
        )
    if fit.flags & cv2.CALIB_FIX_K3 and not fit.flags & cv2.CALIB_FIX_K2 and unknown(5, k2, s[5]):
        return cv2.CALIB_FIX_K2, f"k2 held at 0: found {k2:.3g} ± {s[5]:.2g}"
    if fit.flags & cv2.CALIB_FIX_K2 and not fit.flags & cv2.CALIB_FIX_K1 and unknown(3, k1, s[4]):
        return cv2.CALIB_FIX_K1, f"k1 held at 0: found {k1:.3g} ± {s[4]:.2g}"
    return None


def _fit_fisheye(views: ViewSet) -> _Fit:
    object_points = [v.board_points.reshape(-1, 1, 3) for v in views]
    pixels = [v.pixels.reshape(-1, 1, 2) for v in views]
    flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
    size = (views.camera.width, views.camera.height)
    try:
        rms, K, D, rvecs, tvecs = cv2.fisheye.calibrate(
            object_points, pixels, size, np.eye(3), np.zeros(4), flags=flags, criteria=_STEPS
        )
    except cv2.error as problem:
        raise BadViewsError(
            f"No fisheye lens explains the corners ({problem.err}). Try plumb_bob, or more tilted views."
        ) from None
    per_view = []
    for points, seen, rvec, tvec in zip(object_points, pixels, rvecs, tvecs, strict=True):
        shown, _ = cv2.fisheye.projectPoints(points, rvec, tvec, K, D)
        per_view.append(np.sqrt(np.square(shown.reshape(-1, 2) - seen.reshape(-1, 2)).sum(axis=1).mean()))
    return _Fit(0, float(rms), _floats(K), _floats(D), np.zeros(8), np.array(per_view))
