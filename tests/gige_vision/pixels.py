"""Images of cameras of tests: numbered ones, and their encoding in GenICam's pixel formats."""

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


_noise: dict[tuple[int, int], NDArray[np.uint8]] = {}


def numbered_picture(number: int, width: int, height: int) -> NDArray[np.uint8]:
    """Noise that moves with the number, and the number itself in the first eight bytes; nearly free."""
    if (width, height) not in _noise:
        _noise[width, height] = np.random.default_rng(0).integers(0, 256, (height + 64, width), np.uint8)
    shift = number % 64
    picture = _noise[width, height][shift : shift + height].copy()
    picture.reshape(-1)[:8] = np.frombuffer(number.to_bytes(8, "little"), np.uint8)
    return picture
