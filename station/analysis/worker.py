"""Functions of the daemon's worker process: analysis of images, checks of plans.

Images: board detection, motion between images (a ringing bracket or swinging cable that joints do not show),
and advice on exposure, whose levels are shares of full scale of a linear sensor, as in industrial cameras.
Plain functions of plain data, because they are called in another process.
"""

from __future__ import annotations

import base64
import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from calibrate.boards.detect import Detection, detect
from calibrate.errors import BadViewsError
from calibrate.lens.pnp import planar_tilts
from calibrate.views.corners import Corners
from calibrate.views.view_set import BoardView
from recordings.files import MAIN_CAMERA
from recordings.geometry import Array, transform_points
from recordings.images import Pixels, eight_bits, viewable
from recordings.schema.messages import BoardSpec, CameraModel, Image
from station.analysis.pool import live_with_parent
from station.cell.pose_plan import ExpectedView
from station.cell.status import DetectionStatus
from station.protocol.verbs import PreviewImage

JPEG_LIMIT_BYTES = 200_000
"""Largest JPEG: in base64 it must fit into one line of the protocol."""
_QUALITIES = (75, 50, 30, 15)

WIDTH_PX = 640
"""Width to which images are reduced before measuring motion, to average noise and save time."""
FLAT_GREY = 3.0
"""Variation (1σ, of 255) below which an image is too flat to measure motion."""
_BOARD_GROWTH = 1.6
"""Factor on the board's expected outline for the square in which its motion is measured."""

Box = tuple[float, float, float, float]
"""Left, top, right, bottom, as shares of the image's sides."""

TARGET_WHITE = 0.75
"""Wanted level of the board's white, with room for uneven light before saturation."""
_SATURATED, _SATURATED_SHARE = 0.98, 0.005
_DARK, _BRIGHT = 0.35, 0.95
"""Levels of the board's white"""
_LIT = 0.15
"""Level of the brightest part below which an image without a board is too dark."""
_LEAST_CONTRAST = 0.25
"""Contrast below which the blur cannot be measured."""
_BLUR_PX = 2.0
LONGEST_EXPOSURE_US = 40_000.0
"""Longest exposure that is advised; beyond it gain is raised instead, to keep captures short."""
SHORTEST_EXPOSURE_US = 50.0
HIGHEST_GAIN_DB = 12.0

_NICENESS = 5


def start_worker() -> None:
    """Set up the worker process: low priority and one thread, to leave a processor for the capture."""
    live_with_parent()
    with contextlib.suppress(OSError):  # a service may not be permitted to
        os.nice(_NICENESS)
    cv2.setNumThreads(1)


@dataclass(frozen=True)
class ExposureAdvice:
    cause: str
    """over-exposed, under-exposed or blurred; empty: nothing is wrong."""
    text: str
    """The cause as a sentence for people, with what to set."""
    exposure_us: float
    gain_db: float
    """Advised exposure and gain; the present ones where these are good."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """The board as one image shows it, and the image's light."""

    detection: Detection
    tilt_rad: float | None = None
    """Angle of the board's normal to the optical axis; None: no lens is known."""
    distance_m: float | None = None
    """To the middle of the corners seen."""
    light: ExposureAdvice | None = None
    """None: the image's exposure is not known."""

    @property
    def cause(self) -> str:
        """Why no board was found, or what is wrong with the light; empty: all is well."""
        cause = self.detection.cause
        if self.light is not None and cause in ("", "not-found"):
            return self.light.cause or cause
        return cause


def detection_status(sighting: Sighting) -> DetectionStatus:
    """Make what a screen draws of it."""
    found = sighting.detection
    return DetectionStatus(
        found=found.found,
        reason=found.reason,
        corners=len(found.corners),
        expected=found.expected,
        saturated=round(float(found.saturated), 4),
        coverage=round(float(found.coverage), 4),
        tilt_rad=sighting.tilt_rad,
        distance_m=sighting.distance_m,
        cause=sighting.cause,
        advice="" if sighting.light is None else sighting.light.text,
    )


def sight(
    image: Pixels,
    board: BoardSpec,
    camera: CameraModel | None,
    thorough: bool = True,
    exposure: tuple[float, float] | None = None,
    camera_name: str = MAIN_CAMERA,
) -> Sighting:
    """Look for the board; distance and tilt are given where a lens, even a rough one, is known.

    `exposure`: exposure (µs) and gain (dB) of the image; with it the result holds advice on both.
    """
    found = detect(image, board, thorough, camera=camera_name)
    distance_m = tilt_rad = None
    if found.found and camera is not None and camera.matrix is not None:
        full = camera.width / image.shape[1]  # previews may be smaller than the camera's images
        distance_m, tilt_rad = _distance_and_tilt(found.corners.scaled(full), camera)
    light = None
    if exposure is not None:
        light = assess(image, found.corners.pixels if found.found else None, *exposure)
    return Sighting(found, tilt_rad, distance_m, light)


def _distance_and_tilt(corners: Corners, camera: CameraModel) -> tuple[float | None, float | None]:
    """Compute distance (m) to the board's centre, and angle (rad) of its normal to the optical axis."""
    try:
        C = planar_tilts(BoardView(0, "", np.eye(4), corners), camera)[0]
    except BadViewsError:
        return None, None
    tilt = float(np.arccos(np.clip(abs(C[2, 2]), 0.0, 1.0)))
    centre = transform_points(C, corners.points.mean(axis=0))
    return round(float(np.linalg.norm(centre)), 4), round(tilt, 4)


def assess(image: Pixels, corners: Array | None, exposure_us: float, gain_db: float) -> ExposureAdvice:
    """Advise on exposure and gain from an image (h, w[, 3]) and the settings it was taken with.

    `corners`: the board's detected points (k, 2); None when it was not found: the whole image is used.
    """
    grey = _levels(image)
    # Half of a board is white; without a board take the few brightest pixels, which may saturate.
    region, share, dark = (grey, 97.0, _LIT) if corners is None else (_inside(grey, corners), 85.0, _DARK)
    black, white = (float(v) for v in np.percentile(region, (8.0, share)))
    saturated = float((region >= _SATURATED).mean())
    if saturated > _SATURATED_SHARE or white > _BRIGHT:
        # Clipped levels do not tell how much is too much: the more of them, the larger the step.
        factor = 0.5 if saturated < 0.2 else 0.25
        cause, text = "over-exposed", f"too bright: {saturated:.1%} of the pixels are saturated"
    elif white < dark:
        factor = min(TARGET_WHITE / max(white, 0.01), 16.0)
        cause, text = "under-exposed", f"too dark: the board's white is at {white:.0%} of full scale"
    else:
        blur_px = _blur(grey, white - black)
        if blur_px is None or blur_px <= _BLUR_PX:
            return ExposureAdvice("", "", exposure_us, gain_db)
        text = f"blurred: edges are {blur_px:.1f} px wide; focus the lens, or the arm moves"
        return ExposureAdvice("blurred", text, exposure_us, gain_db)
    # Exposure is raised before gain, and gain is lowered before exposure.
    total_us = exposure_us * 10 ** (gain_db / 20) * factor
    wanted_us = float(np.clip(total_us, SHORTEST_EXPOSURE_US, LONGEST_EXPOSURE_US))
    wanted_db = float(np.clip(20 * np.log10(total_us / wanted_us), 0.0, HIGHEST_GAIN_DB))
    return ExposureAdvice(
        cause, f"{text}; set {wanted_us:.0f} µs and {wanted_db:.1f} dB", wanted_us, wanted_db
    )


def _levels(image: Pixels) -> NDArray[np.float32]:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    if grey.dtype == np.uint8:
        return grey.astype(np.float32) / np.float32(255)
    # 10, 12 and 16 bit images all come as uint16: assume the smallest range that holds the image.
    full = next(f for f in (1023, 4095, 65535) if grey.max() <= f)
    return grey.astype(np.float32) / np.float32(full)


def _inside(grey: NDArray[np.float32], corners: Array) -> NDArray[np.float32]:
    mask = np.zeros(grey.shape, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.round(corners).astype(np.int32)), 1)
    return grey[mask.astype(bool)] if mask.any() else grey.ravel()


def _blur(grey: NDArray[np.float32], contrast: float) -> float | None:
    """Measure the Gaussian sigma of the sharpest edges: their slope is contrast / (sigma √(2π))."""
    if contrast < _LEAST_CONTRAST:
        return None
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8)
    steepest = float(np.percentile(np.hypot(dx, dy), 99.8))
    return contrast / (steepest * float(np.sqrt(2 * np.pi))) if steepest > 0 else None


def board_box(view: ExpectedView | None, width: int, height: int) -> Box | None:
    """Predict the board's square in an image of this size (px); None where it is not known."""
    if view is None or view.coverage <= 0 or width <= 0 or height <= 0:
        return None
    half = _BOARD_GROWTH * np.sqrt(view.coverage * width * height) / 2
    x, y = view.centre_px
    box = ((x - half) / width, (y - half) / height, (x + half) / width, (y + half) / height)
    left, top, right, bottom = (float(np.clip(share, 0.0, 1.0)) for share in box)
    return (left, top, right, bottom) if right - left > 0.1 and bottom - top > 0.1 else None


def image_motion(images: Sequence[Pixels], full_width: int = 0, box: Box | None = None) -> float | None:
    """Largest shift of the newest image against the others, px of an image `full_width` wide (0 = this).

    By phase correlation (Kuglin & Hines 1975) under a Hann window: 0 within 0.05 px where nothing moves, a
    motion good to 0.3 px, both of the reduced image. None when the newest image is flat. `box`: look
    only there.
    """
    *earlier, newest = (_reduced(image, box) for image in images)
    if newest.std() < FLAT_GREY:
        return None
    window = cv2.createHanningWindow((newest.shape[1], newest.shape[0]), cv2.CV_32F)
    # Copies, because OpenCV multiplies its input arrays by the window in place.
    shifts = [cv2.phaseCorrelate(image, newest.copy(), window)[0] for image in earlier]
    width = images[-1].shape[1]
    scale = (full_width or width) / min(width, WIDTH_PX)
    return float(scale * max(np.hypot(x, y) for x, y in shifts))


def _reduced(image: Pixels, box: Box | None) -> NDArray[np.float32]:
    """Convert to grey, 0…255, at most `WIDTH_PX` wide, with sides whose Fourier transform is even.

    Where it is odd, `cv2.phaseCorrelate` finds half a pixel of motion in images at rest.
    """
    height, width = image.shape[:2]
    if box is not None:
        left, top, right, bottom = box
        image = image[
            round(top * height) : round(bottom * height), round(left * width) : round(right * width)
        ]
    grey: NDArray[np.floating | np.integer] = image
    if image.dtype == np.uint16:
        grey = image.astype(np.float32) / 257.0
    if image.ndim == 3:
        grey = cv2.cvtColor(grey, cv2.COLOR_BGR2GRAY)
    scale = min(1.0, WIDTH_PX / width)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    rows, columns = (
        next(n for n in range(n, 0, -1) if cv2.getOptimalDFTSize(n) % 2 == 0) for n in small.shape
    )
    return np.asarray(small[:rows, :columns], dtype=np.float32)


def smaller_image(taken: Image, side_px: int) -> Image:
    """Reduce an image whose longer side is longer than this, and interpolate its colour mosaic."""
    pixels = viewable(taken.pixels, taken.pixel_format)
    scale = side_px / max(pixels.shape[:2])
    if scale >= 1.0:
        return taken
    small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return msgspec.structs.replace(taken, pixels=small)


def preview_image(taken: Image, corners: Array, width: int, height: int, sequence: int) -> PreviewImage:
    """Make a JPEG that fits into width × height, px; empty where none is small enough.

    `corners`: (n, 2) of the image, px. `sequence`: number that differs for every image.
    """
    image = eight_bits(viewable(taken.pixels, taken.pixel_format), taken.pixel_format)
    sides = image.shape[1::-1]
    scale = min(width / sides[0], height / sides[1], 1.0)
    size = max(1, round(sides[0] * scale)), max(1, round(sides[1] * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    shares = (corners.reshape(-1, 2) + 0.5) / np.array(sides)
    for quality in _QUALITIES:
        ok, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if ok and len(jpeg) <= JPEG_LIMIT_BYTES:
            data = base64.b64encode(jpeg.tobytes()).decode()
            found = tuple((float(x), float(y)) for x, y in shares.round(4))
            return PreviewImage(data, *size, found, sequence)
    return PreviewImage()
