"""An image as a screen shows it: small, in grey, with the board's corners."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from calibrate.geometry import Array
from recordings.images import eight_bits
from recordings.schema.messages import Image
from station.protocol.verbs import PreviewImage

JPEG_LIMIT_BYTES = 40_000
"""In base64 it must fit into one line of the protocol."""
_QUALITIES = (75, 50, 30, 15)


def preview_image(taken: Image, corners: Array, width: int, height: int, sequence: int) -> PreviewImage:
    """A JPEG that fits into width × height, px; empty where none is small enough.

    `corners`: (n, 2) of the image, px. `sequence`: another number for another image.
    """
    image = eight_bits(taken.viewable(), taken.pixel_format)
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
