"""The lens, found from the session's own pictures (Zhang), holding what the pictures cannot tell.

Z. Zhang, "A flexible new technique for camera calibration" (2000). Plumb-bob: `lens_fit`; other lenses by
OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np

from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.geometry import Array
from calibrate.lens_fit import LensFit, first_fit, refit
from calibrate.projection import INTRINSICS, camera_matrix, intrinsics_vector
from calibrate.views import ViewSet
from recordings.messages import CameraModel

LensModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

FEWEST_VIEWS = 3
_SIGNIFICANT_SIGMAS = 2.0
"""A coefficient that is nearer to zero is not told from it."""
_LARGEST_BEND_PX = 1.0
"""By which such a one may bend the picture's corner (1σ) and still be left free."""
_LARGEST_CENTRE_SIGMA_SHARE = 0.03
"""Of the picture's longer side: a principal point known worse (1σ) is held."""
_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-9)
_POWERS = {"k1": 3, "k2": 5, "p1": 2, "p2": 2, "k3": 7}
"""Of the distance from the middle, by which a coefficient bends."""
_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, eq=False)
class Intrinsics:
    camera: CameraModel
    rms_px: float
    """Of the corners' distances from where the lens shows them; without dropped views."""
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
    rms_px: float
    K: Array
    D: Array
    sigma: Array
    per_view: Array


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
            fit, held = _FITS[model](used)
        except (cv2.error, np.linalg.LinAlgError) as problem:
            reason = problem.err if isinstance(problem, cv2.error) else problem
            raise BadViewsError(
                f"The lens cannot be found from these corners ({reason}). Check the board's size."
            ) from None
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
    if not (0.2 * max(size) < fit.K[0, 0] < 100 * max(size) and fit.rms_px <= 0.01 * max(size)):
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


def _fit_plumb_bob(views: ViewSet) -> tuple[_Fit, tuple[str, ...]]:
    """Holding one after the other what the pictures do not determine."""
    fit = first_fit(views)
    held: list[str] = []
    while (more := _undetermined(fit)) is not None:
        names, text = more
        held.append(text)
        fit = refit(views, fit, (*fit.held, *names))
    D = np.array(fit.camera.distortion)
    return _Fit(fit.rms_px, camera_matrix(fit.camera), D, fit.sigma, fit.view_rms_px), tuple(held)


def _undetermined(fit: LensFit) -> tuple[tuple[str, ...], str] | None:
    """The next parameters to hold, and a sentence; None when all are determined."""
    value = dict(zip(INTRINSICS, intrinsics_vector(fit.camera).tolist(), strict=True))
    sigma = dict(zip(INTRINSICS, fit.sigma.tolist(), strict=True))
    size = np.array([fit.camera.width, fit.camera.height])
    centre = np.array([value["cx"], value["cy"]])
    corner = float(np.linalg.norm(np.maximum(centre, size - centre))) / value["fx"]

    def unknown(name: str) -> bool:
        """Not told from zero, and left free it could bend the picture's corner by more than a pixel.

        A value that would throw the corner out of the picture comes from a singular fit, whatever its sigma.
        """
        lever_px = value["fx"] * corner ** _POWERS[name]
        if lever_px * abs(value[name]) > size.max():
            return True
        vague = abs(value[name]) < _SIGNIFICANT_SIGMAS * sigma[name]
        return bool(vague and lever_px * sigma[name] > _LARGEST_BEND_PX)

    if (text := _centre_unknown(fit.sigma, size)) and "cx" not in fit.held:
        return ("cx", "cy"), text
    if "k3" not in fit.held and unknown("k3"):
        return ("k3",), f"k3 held at 0: found {value['k3']:.3g} ± {sigma['k3']:.2g}"
    if "p1" not in fit.held and unknown("p1") and unknown("p2"):
        p1, p2 = (f"{value[name]:.2g} ± {sigma[name]:.1g}" for name in ("p1", "p2"))
        return ("p1", "p2"), f"p1, p2 held at 0: found {p1}, {p2}"
    for name, before in (("k2", "k3"), ("k1", "k2")):
        if before in fit.held and name not in fit.held and unknown(name):
            return (name,), f"{name} held at 0: found {value[name]:.3g} ± {sigma[name]:.2g}"
    return None


def _centre_unknown(sigma: Array, size: Array) -> str:
    """A sentence when the views do not fix the principal point, else ""."""
    sigma_px = float(max(sigma[2], sigma[3]))
    if not sigma_px > _LARGEST_CENTRE_SIGMA_SHARE * size.max():
        return ""
    return f"principal point held at the centre: the views know it only to {sigma_px:.0f} px"


def _fit_rational(views: ViewSet) -> tuple[_Fit, tuple[str, ...]]:
    fit = _opencv_rational(views, 0)
    text = _centre_unknown(fit.sigma, np.array([views.camera.width, views.camera.height]))
    return (_opencv_rational(views, cv2.CALIB_FIX_PRINCIPAL_POINT), (text,)) if text else (fit, ())


def _opencv_rational(views: ViewSet, flags: int) -> _Fit:
    object_points = [v.board_points.astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32) for v in views]
    size = (views.camera.width, views.camera.height)
    flags |= cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_USE_LU
    before = cv2.getNumThreads()
    # OpenCV's threads sum in the order they finish: the last bits would differ from run to run.
    cv2.setNumThreads(1)
    try:
        unknown: Any = None
        rms, K, D, _, _, sigma, _, per_view = cv2.calibrateCameraExtended(
            object_points, pixels, size, unknown, unknown, flags=flags, criteria=_STEPS
        )
    finally:
        cv2.setNumThreads(before)
    return _Fit(float(rms), _floats(K), _floats(D)[:8], _floats(sigma)[:12], _floats(per_view))


def _floats(values: Any) -> Array:
    found = np.asarray(values, dtype=np.float64)
    return found if found.shape == (3, 3) else found.ravel()


def _fit_fisheye(views: ViewSet) -> tuple[_Fit, tuple[str, ...]]:
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
    return _Fit(float(rms), _floats(K), _floats(D), np.zeros(8), np.array(per_view)), ()


_FITS: dict[LensModel, Callable[[ViewSet], tuple[_Fit, tuple[str, ...]]]] = {
    "plumb_bob": _fit_plumb_bob,
    "rational_polynomial": _fit_rational,
    "equidistant": _fit_fisheye,
}
