"""Encoding of images in GenICam's pixel formats, for cameras of tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def encode(grey: NDArray[np.uint8], pixel_format: str) -> bytes:
    """Encode a grey image (height, width) in a pixel format; in colour formats all channels are grey."""
    if pixel_format in ("RGB8", "BGR8"):
        return np.repeat(grey[:, :, None], 3, axis=2).tobytes()
    if pixel_format == "Mono8" or pixel_format.startswith("Bayer"):
        return grey.tobytes()
    wide, bits = grey.astype("<u2"), int(pixel_format.removeprefix("Mono"))
    return (wide << (bits - 8) | wide >> (16 - bits)).astype("<u2").tobytes()
