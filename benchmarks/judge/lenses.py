"""Projection by the three usual lens models, as OpenCV's documentation writes them.

D. C. Brown, "Close-range camera calibration" (1971) with the rational radial part of D. Claus, A. W.
Fitzgibbon (2005); J. Kannala, S. S. Brandt (2006) for the fisheye. Pixel (0, 0) is the first pixel's centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.judge.frames import Array

LensModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]


@dataclass(frozen=True)
class Lens:
    """A camera of `width` × `height` pixels."""

    model: LensModel
    focal_px: tuple[float, float]
    """Along x and y."""
    centre_px: tuple[float, float]
    distortion: tuple[float, ...]
    """k1 k2 p1 p2 k3 (plumb-bob), then k4 k5 k6 (rational); k1 … k4 (fisheye)."""
    width: int = 1280
    height: int = 1024

    def project(self, points: Array, scale: float = 1.0) -> Array:
        """Pixels (..., 2) of points (..., 3) in the camera's frame; `scale` is that of the picture."""
        x = points[..., 0] / points[..., 2]
        y = points[..., 1] / points[..., 2]
        bent = self._fisheye(x, y) if self.model == "equidistant" else self._brown(x, y)
        return np.asarray(scale * np.array(self.focal_px) * bent + np.array(self.centre_px))

    def _brown(self, x: Array, y: Array) -> Array:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, 0.0, 0.0, 0.0)[:8]
        r2 = x * x + y * y
        above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = above / below
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([bent_x, bent_y], axis=-1)

    def _fisheye(self, x: Array, y: Array) -> Array:
        k1, k2, k3, k4 = self.distortion
        r = np.hypot(x, y)
        theta = np.arctan(r)
        square = theta * theta
        bent = theta * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
        ratio = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
        return np.stack([x * ratio, y * ratio], axis=-1)


LENSES: dict[LensModel, Lens] = {
    "plumb_bob": Lens("plumb_bob", (1200.0, 1200.0), (641.0, 509.0), (-0.11, 0.09, 4e-4, -5e-4, 0.0)),
    "rational_polynomial": Lens(
        "rational_polynomial",
        (900.0, 900.0),
        (641.0, 509.0),
        (0.3, -0.1, 4e-4, -5e-4, 0.02, 0.55, -0.05, 0.03),
    ),
    "equidistant": Lens("equidistant", (900.0, 900.0), (641.0, 509.0), (0.01, -0.02, 0.005, -0.001)),
}
