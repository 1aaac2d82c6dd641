"""The exposure assistant: reads an image of the board and says what to set, and what else is wrong.

All levels are shares of full scale, 0 … 1. It assumes a linear sensor, as machine vision cameras are.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.geometry import Array
from recordings.images import Pixels

TARGET_WHITE = 0.75
"""The board's white: bright, with room for uneven light before it saturates."""
_KEEP = (0.8, 1.25)
"""Factors not worth a change"""
_SATURATED, _SATURATED_SHARE = 0.98, 0.005
_DARK_WHITE, _BRIGHT_WHITE = 0.35, 0.95
_LOW_CONTRAST = 0.25
_BLUR_PX = 2.0
LONGEST_EXPOSURE_US = 40_000.0
"""The arm is at rest, but not for ever: beyond this, gain is raised instead."""
SHORTEST_EXPOSURE_US = 50.0
HIGHEST_GAIN_DB = 12.0


@dataclass(frozen=True)
class ExposureAdvice:
    exposure_us: float
    gain_db: float
    """Settings advised; those in use where they are good."""
    white: float
    black: float
    saturated: float
    """Share of pixels"""
    blur_px: float | None
    """Sigma of the sharpest edges; None where there is too little contrast to tell."""
    warnings: tuple[str, ...]
    """Sentences for people; empty = all is well."""


def assess(
    image: Pixels,
    corners: Array | None,
    exposure_us: float,
    gain_db: float,
) -> ExposureAdvice:
    """Advises on an image (h, w[, 3]) taken at this exposure and gain.

    `corners`: the board's detected points (k, 2), None when it was not found: the whole image counts then.
    """
    grey = _levels(image)
    # A board is half white; without one, the few brightest pixels are what may saturate.
    region, share = (grey, 97.0) if corners is None else (_inside(grey, corners), 85.0)
    black, white = (float(v) for v in np.percentile(region, (8.0, share)))
    saturated = float((region >= _SATURATED).mean())
    factor = _factor(black, white, saturated)
    wanted_us, wanted_db = _settings(exposure_us, gain_db, factor)
    blur_px = _blur(grey, white - black)
    advice = f"set {wanted_us:.0f} µs and {wanted_db:.1f} dB"
    warnings = []
    if saturated > _SATURATED_SHARE or white > _BRIGHT_WHITE:
        warnings.append(f"too bright: {saturated:.1%} of the pixels are saturated; {advice}")
    elif white < _DARK_WHITE:
        warnings.append(f"too dark: the board's white is at {white:.0%} of full scale; {advice}")
    elif white - black < _LOW_CONTRAST:
        warnings.append(
            f"low contrast: white {white:.0%}, black {black:.0%}; look for reflections and stray light"
        )
    if blur_px is not None and blur_px > _BLUR_PX:
        warnings.append(f"blurred: edges are {blur_px:.1f} px wide; focus the lens, or the arm moves")
    return ExposureAdvice(wanted_us, wanted_db, white, black, saturated, blur_px, tuple(warnings))


def _levels(image: Pixels) -> NDArray[np.float32]:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    if grey.dtype == np.uint8:
        return grey.astype(np.float32) / np.float32(255)
    # 10, 12 and 16 bit images all come as uint16: the smallest range that holds the image is meant.
    full = next(f for f in (1023, 4095, 65535) if grey.max() <= f)
    return grey.astype(np.float32) / np.float32(full)


def _inside(grey: NDArray[np.float32], corners: Array) -> NDArray[np.float32]:
    mask = np.zeros(grey.shape, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.round(corners).astype(np.int32)), 1)
    return grey[mask.astype(bool)] if mask.any() else grey.ravel()


def _factor(black: float, white: float, saturated: float) -> float:
    """By how much the light must grow for white to reach its target."""
    if saturated > _SATURATED_SHARE:
        # Clipped levels say only "too much": the more of them, the bolder the step.
        return 0.5 if saturated < 0.2 else 0.25
    factor = TARGET_WHITE / max(white, 0.01)
    return 1.0 if _KEEP[0] <= factor <= _KEEP[1] else min(factor, 16.0)


def _settings(exposure_us: float, gain_db: float, factor: float) -> tuple[float, float]:
    """Light is spent on exposure first; gain comes last and goes first."""
    if factor == 1.0:
        return exposure_us, gain_db
    total_us = exposure_us * 10 ** (gain_db / 20) * factor
    wanted_us = float(np.clip(total_us, SHORTEST_EXPOSURE_US, LONGEST_EXPOSURE_US))
    wanted_db = float(np.clip(20 * np.log10(total_us / wanted_us), 0.0, HIGHEST_GAIN_DB))
    return wanted_us, wanted_db


def _blur(grey: NDArray[np.float32], contrast: float) -> float | None:
    """Gaussian sigma of the sharpest edges: their slope is contrast / (sigma √(2π))."""
    if contrast < _LOW_CONTRAST:
        return None
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=1 / 8)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=1 / 8)
    steepest = float(np.percentile(np.hypot(dx, dy), 99.8))
    return contrast / (steepest * float(np.sqrt(2 * np.pi))) if steepest > 0 else None
