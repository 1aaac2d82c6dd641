"""Image motion between exposures: a ringing bracket, a swinging cable, unknown to the joints."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from recordings.images import Pixels
from station.cell.plan import ExpectedView

WIDTH_PX = 640
"""Images are made this small first: it averages their noise, and takes a few milliseconds."""
FLAT_GREY = 3.0
"""An image that varies less than this (1σ, of 255) shows nothing whose motion could be seen."""
_BOARD_GROWTH = 1.6
"""The board is looked for in a square this much wider than its expected outline."""

Box = tuple[float, float, float, float]
"""Left, top, right, bottom, as shares of the image's sides."""


def board_box(view: ExpectedView | None, width: int, height: int) -> Box | None:
    """Where the board should stand in an image of this size (px); None where that is not known."""
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
    # A copy each: OpenCV lays the window over the very arrays it is given.
    shifts = [cv2.phaseCorrelate(image, newest.copy(), window)[0] for image in earlier]
    share = 1.0 if box is None else box[2] - box[0]
    scale = (full_width or images[-1].shape[1]) * share / newest.shape[1]
    return float(scale * max(np.hypot(x, y) for x, y in shifts))


def _reduced(image: Pixels, box: Box | None) -> NDArray[np.float32]:
    """Grey, 0…255, at most `WIDTH_PX` wide."""
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
    return np.asarray(small, dtype=np.float32)
