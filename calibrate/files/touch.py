"""Touch test: a tip that a person brought onto a corner of the board, and the calibration's offset there.

The entries live in the calibration file.
"""

from __future__ import annotations

import math
from typing import Literal

import msgspec
import numpy as np


class Touch(msgspec.Struct, frozen=True, omit_defaults=True):
    """How far the calibration puts a corner from where a person touched it."""

    corner: int
    """Row of `board.board_points`."""
    corner_mm: tuple[float, float]
    """x, y on the board."""
    offset_mm: tuple[float, float]
    """Tip minus true corner along the board's x and y, had the calibration sent the tip there."""
    sigma_mm: tuple[float, float]
    """1 sigma of it that calibration, picture and robot predict."""
    found: Literal["told by a person", "read from the arm"]
    who: str
    wall: str
    pointer: str = ""
    note: str = ""


HAND_MM = 0.3
"""1 sigma per axis of reading an offset or meeting a corner by hand and eye."""
CONFIDENCE = 0.99
"""Probability that one sound corner passes; several share the error of X, so few alarm by chance."""
LIMIT_SIGMAS = math.sqrt(-2 * math.log(1 - CONFIDENCE))
"""Limit for two numbers: χ²(2) at `CONFIDENCE`, 3.03."""


def touch_sigmas(touch: Touch) -> float:
    """Offset in sigmas of prediction and hand together: √Σ o² / (σ² + `HAND_MM`²)."""
    offset, sigma = np.array(touch.offset_mm), np.array(touch.sigma_mm)
    return float(np.sqrt(np.square(offset / np.hypot(sigma, HAND_MM)).sum()))


def agrees(touch: Touch) -> bool:
    """Tell whether the offset is within what was predicted."""
    return touch_sigmas(touch) <= LIMIT_SIGMAS


def touch_text(touch: Touch) -> str:
    """'corner 0: 0.31 mm (x +0.21, y -0.23), 0.9σ (limit 3.0) PASS'"""
    x, y = touch.offset_mm
    verdict = "PASS" if agrees(touch) else "FAIL"
    figures = f"{np.hypot(x, y):.2f} mm (x {x:+.2f}, y {y:+.2f}), {touch_sigmas(touch):.1f}σ"
    return f"corner {touch.corner}: {figures} (limit {LIMIT_SIGMAS:.1f}) {verdict}"
