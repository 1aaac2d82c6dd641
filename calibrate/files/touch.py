"""Touch test: offset between a board corner that a person touched and where the calibration puts it.

The entries are kept in the calibration file.
"""

from __future__ import annotations

import math
from typing import Literal

import msgspec
import numpy as np


class Touch(msgspec.Struct, frozen=True, omit_defaults=True):
    """Result at one corner: where the tip would have gone by the calibration, against the true corner."""

    corner: int
    """Row of `board.board_points`."""
    corner_mm: tuple[float, float]
    """Position x, y on the board."""
    offset_mm: tuple[float, float]
    """Tip minus true corner along the board's x and y if the tip were sent there by the calibration."""
    sigma_mm: tuple[float, float]
    """1σ of `offset_mm` predicted from the uncertainties of calibration, image and robot."""
    found: Literal["told by a person", "read from the arm"]
    who: str
    wall: str
    pointer: str = ""
    note: str = ""


HAND_MM = 0.3
"""1σ per axis of reading an offset, or touching a corner, by hand and eye."""
CONFIDENCE = 0.99
"""Probability that a corner passes if the calibration is right."""
LIMIT_SIGMAS = math.sqrt(-2 * math.log(1 - CONFIDENCE))
"""Limit of the length of two normalised offsets: root of χ²(2) at `CONFIDENCE`, 3.03."""


def touch_sigmas(touch: Touch) -> float:
    """Compute the offset in sigmas of prediction and hand together: √Σ o² / (σ² + `HAND_MM`²)."""
    offset, sigma = np.array(touch.offset_mm), np.array(touch.sigma_mm)
    return float(np.sqrt(np.square(offset / np.hypot(sigma, HAND_MM)).sum()))


def agrees(touch: Touch) -> bool:
    """Tell whether the offset is within `LIMIT_SIGMAS`."""
    return touch_sigmas(touch) <= LIMIT_SIGMAS


def touch_text(touch: Touch) -> str:
    """Write 'corner 0: 0.31 mm (x +0.21, y -0.23), 0.9σ (limit 3.0) PASS'."""
    x, y = touch.offset_mm
    verdict = "PASS" if agrees(touch) else "FAIL"
    figures = f"{np.hypot(x, y):.2f} mm (x {x:+.2f}, y {y:+.2f}), {touch_sigmas(touch):.1f}σ"
    return f"corner {touch.corner}: {figures} (limit {LIMIT_SIGMAS:.1f}) {verdict}"
