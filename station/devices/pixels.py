"""GenICam pixel formats: decoding bytes to images."""

from __future__ import annotations

import numpy as np

from recordings.images import Pixels
from station.cell.errors import CameraError

_WIDE = ("Mono10", "Mono12", "Mono16")
_COLOUR = ("RGB8", "BGR8")
FORMATS = ("Mono8", *_WIDE, "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8", *_COLOUR)


def bytes_per_pixel(pixel_format: str) -> int:
    """Return the bytes per pixel on the wire. CameraError for a format that is not supported."""
    if pixel_format not in FORMATS:
        raise CameraError("pixel-format", pixel_format=pixel_format, formats=", ".join(FORMATS))
    return 3 if pixel_format in _COLOUR else 2 if pixel_format in _WIDE else 1


def decode(data: bytes, width: int, height: int, pixel_format: str) -> Pixels:
    """Decode to (height, width) uint8 or uint16 (10 and 12 bits unscaled), or (height, width, 3) uint8 BGR.

    A Bayer mosaic stays a mosaic. CameraError when there are too few bytes.
    """
    size = width * height * bytes_per_pixel(pixel_format)
    if len(data) < size:
        raise CameraError("image-size", size_bytes=len(data), needed_bytes=size, pixel_format=pixel_format)
    raw = np.frombuffer(data, np.uint8, size)
    if pixel_format in _WIDE:
        return raw.view("<u2").reshape(height, width)
    if pixel_format in _COLOUR:
        image = raw.reshape(height, width, 3)
        return image if pixel_format == "BGR8" else np.ascontiguousarray(image[:, :, ::-1])
    return raw.reshape(height, width)
