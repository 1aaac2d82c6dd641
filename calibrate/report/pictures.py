"""Small pictures of the views with what was found drawn on them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from calibrate.boards.corners import to_grey
from calibrate.geometry import Array

_WIDTH_PX = 480


def drawn_view(image: Any, found: Array, modelled: Array | None) -> bytes:
    """JPEG of the picture, brightened, with the found corners (orange) and the modelled ones (blue rings)."""
    grey = to_grey(image)
    scale = _WIDTH_PX / grey.shape[1]
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    top = max(float(np.percentile(small, 99.5)), 1.0)
    canvas = cv2.cvtColor(np.clip(small * (245.0 / top), 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    if modelled is not None:
        for x, y in _places(modelled, scale):
            cv2.circle(canvas, (x, y), 7, (218, 105, 9), 2, cv2.LINE_AA)
    for k, (x, y) in enumerate(_places(found, scale)):
        colour = (0, 0, 255) if k == 0 else (0, 140, 255)
        cv2.drawMarker(canvas, (x, y), colour, cv2.MARKER_CROSS, 8 if k else 18, 2)
    _, jpeg = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, 70])
    return jpeg.tobytes()


def _places(pixels: Array, scale: float) -> list[tuple[int, int]]:
    scaled = (pixels + 0.5) * scale - 0.5
    finite = np.isfinite(scaled).all(axis=1) & (np.abs(scaled) < 10_000).all(axis=1)
    return [(round(x), round(y)) for x, y in scaled[finite].tolist()]
