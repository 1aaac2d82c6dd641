"""GenICam pixel formats: decoding bytes to images, and encoding for the simulated camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.images import Pixels
from station.cell.errors import CameraError

_BAYER = ("BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8")
FORMATS = (
    "Mono8",
    "Mono10",
    "Mono12",
    "Mono16",
    "Mono10Packed",
    "Mono12Packed",
    "Mono10p",
    "Mono12p",
    *_BAYER,
    "RGB8",
    "BGR8",
)


def bits_per_pixel(pixel_format: str) -> int:
    """Return the bits per pixel on the wire. CameraError for a format that is not supported."""
    if pixel_format not in FORMATS:
        raise CameraError("pixel-format", pixel_format=pixel_format, formats=", ".join(FORMATS))
    if pixel_format in ("RGB8", "BGR8"):
        return 24
    if pixel_format == "Mono10p":
        return 10
    if pixel_format in ("Mono10Packed", "Mono12Packed", "Mono12p"):
        return 12
    return 16 if pixel_format in ("Mono10", "Mono12", "Mono16") else 8


def decode(data: bytes, width: int, height: int, pixel_format: str) -> Pixels:
    """Decode to (height, width) uint8 or uint16 (10 and 12 bits unscaled), or (height, width, 3) uint8 BGR.

    A Bayer mosaic stays a mosaic. CameraError when there are too few bytes.
    """
    size = (width * height * bits_per_pixel(pixel_format) + 7) // 8
    if len(data) < size:
        raise CameraError("image-size", size_bytes=len(data), needed_bytes=size, pixel_format=pixel_format)
    raw = np.frombuffer(data, np.uint8, size)
    if pixel_format == "Mono8" or pixel_format in _BAYER:
        return raw.reshape(height, width)
    if pixel_format in ("Mono10", "Mono12", "Mono16"):
        return raw.view("<u2").reshape(height, width)
    if pixel_format == "BGR8":
        return raw.reshape(height, width, 3)
    if pixel_format == "RGB8":
        return np.ascontiguousarray(raw.reshape(height, width, 3)[:, :, ::-1])
    return _unpack(raw, width * height, pixel_format).reshape(height, width)


def _unpack(raw: NDArray[np.uint8], count: int, pixel_format: str) -> NDArray[np.uint16]:
    """Unpack 10 or 12 bit pixels.

    Formats "…Packed" (GigE Vision 1) hold two pixels in three bytes, the low bits in the middle one; "…p" are
    a bit stream.
    """
    if pixel_format in ("Mono10Packed", "Mono12Packed"):
        triple = np.resize(raw, (count + 1) // 2 * 3).reshape(-1, 3).astype(np.uint16)
        shift, mask = (4, 0xF) if pixel_format == "Mono12Packed" else (2, 0x3)
        values = np.empty((len(triple), 2), np.uint16)
        values[:, 0] = triple[:, 0] << shift | triple[:, 1] & mask
        values[:, 1] = triple[:, 2] << shift | triple[:, 1] >> 4 & mask
        return values.ravel()[:count]
    bits = 10 if pixel_format == "Mono10p" else 12
    stream = np.unpackbits(raw, bitorder="little")[: count * bits].reshape(count, bits)
    weights = (1 << np.arange(bits)).astype(np.uint16)
    return np.asarray(stream @ weights, dtype=np.uint16)


def encode(grey: NDArray[np.uint8], pixel_format: str) -> bytes:
    """Encode a grey image (height, width) in a pixel format; in colour formats all channels are grey."""
    wide = grey.astype(np.uint16)
    if bits_per_pixel(pixel_format) == 8:
        return grey.tobytes()
    if pixel_format in ("RGB8", "BGR8"):
        return np.repeat(grey[:, :, None], 3, axis=2).tobytes()
    bits = int("".join(filter(str.isdigit, pixel_format)))
    values = (wide << (bits - 8) | wide >> (16 - bits)).ravel()
    if pixel_format in ("Mono10", "Mono12", "Mono16"):
        return values.astype("<u2").tobytes()
    if pixel_format.endswith("p"):
        stream = (values[:, None] >> np.arange(bits) & 1).astype(np.uint8)
        return np.packbits(stream, bitorder="little").tobytes()
    shift = bits - 8
    pair = np.resize(values, (len(values) + 1) // 2 * 2).reshape(-1, 2)
    mask = (1 << shift) - 1
    packed = np.stack(
        [pair[:, 0] >> shift, pair[:, 0] & mask | (pair[:, 1] & mask) << 4, pair[:, 1] >> shift], 1
    )
    return packed.astype(np.uint8).tobytes()
