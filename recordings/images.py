"""Image bytes: raw buffers with a named layout, and PNG/JPEG whose size is read before decoding."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from recordings.image_headers import ImageError, check_complete, read_header

Pixels = NDArray[np.uint8 | np.uint16]
"""(height, width), or (height, width, 3) as BGR."""

_BAYER = {
    "BayerRG8": ("bayer_rggb8", cv2.COLOR_BayerRGGB2BGR),
    "BayerBG8": ("bayer_bggr8", cv2.COLOR_BayerBGGR2BGR),
    "BayerGB8": ("bayer_gbrg8", cv2.COLOR_BayerGBRG2BGR),
    "BayerGR8": ("bayer_grbg8", cv2.COLOR_BayerGRBG2BGR),
}
"""Colour mosaics: foxglove's name, and OpenCV's way to BGR"""


def decode_image(data: bytes, width: int, height: int) -> Pixels:
    """Compressed bytes → (height, width) uint8/uint16 or (height, width, 3) uint8 BGR, as stored.

    The size in the header must be the expected one before anything is decoded. Raises ImageError.
    """
    header = read_header(data)
    if (header.width, header.height) != (width, height):
        raise ImageError(f"is {header.width}×{header.height}, expected {width}×{height}")
    check_complete(data, header)
    flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f"cannot be decoded ({error.err})") from error
    if image is None or image.shape[:2] != (height, width):
        raise ImageError("is damaged or cut: it cannot be decoded")
    decoded: Pixels = np.asarray(image)
    if decoded.ndim == 3 and decoded.dtype == np.uint16:
        return np.asarray(np.right_shift(decoded, 8), np.uint8)
    if decoded.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"holds {decoded.dtype}, as a map of depths does; a picture has 8 or 16 bits")
    return decoded


def encode_png(image: Pixels) -> bytes:
    """Lossless. Level 1 with run lengths: fastest, and nearly the smallest on noisy images."""
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    done, data = cv2.imencode(".png", image, options)
    if not done:
        raise ImageError("could not be compressed")
    return data.tobytes()


def pixel_format_of(pixels: Pixels, encoding: str = "") -> str:
    """GenICam's name for an array as recordings hold it. `encoding`: foxglove's and ROS's name, if known."""
    for name, (mosaic, _) in _BAYER.items():
        if mosaic == encoding and pixels.ndim == 2 and pixels.dtype == np.uint8:
            return name
    return "BGR8" if pixels.ndim == 3 else "Mono8" if pixels.itemsize == 1 else "Mono16"


def mosaic_encoding(pixel_format: str) -> str:
    """Foxglove's and ROS's name of a colour mosaic; '' for images of any other kind."""
    return _BAYER[pixel_format][0] if pixel_format in _BAYER else ""


def raw_encoding(image: Pixels, pixel_format: str) -> str:
    """The name foxglove.RawImage uses for this array's layout. ImageError for any other array."""
    if image.ndim == 2 and image.dtype == np.uint8:
        return mosaic_encoding(pixel_format) or "mono8"
    if image.ndim == 2 and image.dtype == np.uint16:
        return "mono16"
    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
        return "bgr8"
    raise ImageError(f"an image of shape {image.shape} and type {image.dtype} cannot be recorded")


def viewable(pixels: Pixels, pixel_format: str) -> Pixels:
    """Convert for people and detectors: a colour mosaic interpolated to BGR, everything else as it is."""
    if pixel_format in _BAYER and pixels.ndim == 2:
        return np.asarray(cv2.cvtColor(pixels, _BAYER[pixel_format][1]))
    return pixels


def eight_bits(pixels: Pixels, pixel_format: str) -> NDArray[np.uint8]:
    """The same for a screen: Mono10 … Mono16 by their highest bits."""
    if pixels.dtype == np.uint8:
        return np.asarray(pixels, np.uint8)
    bits = int("".join(filter(str.isdigit, pixel_format)) or 16)
    return np.asarray(np.minimum(pixels >> max(bits - 8, 0), 255), np.uint8)


_LAYOUTS: dict[str, tuple[int, Any, int | None]] = {
    "mono8": (1, np.uint8, None), "8UC1": (1, np.uint8, None), "mono16": (1, "<u2", None),
    "bgr8": (3, np.uint8, None), "8UC3": (3, np.uint8, None), "rgb8": (3, np.uint8, cv2.COLOR_RGB2BGR),
    "bgra8": (4, np.uint8, cv2.COLOR_BGRA2BGR), "rgba8": (4, np.uint8, cv2.COLOR_RGBA2BGR),
    "bayer_rggb8": (1, np.uint8, None), "bayer_bggr8": (1, np.uint8, None),
    "bayer_gbrg8": (1, np.uint8, None), "bayer_grbg8": (1, np.uint8, None),
    "yuv422": (2, np.uint8, cv2.COLOR_YUV2BGR_UYVY), "uyvy": (2, np.uint8, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, np.uint8, cv2.COLOR_YUV2BGR_YUYV), "yuyv": (2, np.uint8, cv2.COLOR_YUV2BGR_YUYV),
}  # fmt: skip
"""Encoding → channels, number type, conversion."""


def raw_array(data: bytes, encoding: str, width: int, height: int, step: int = 0) -> Pixels:
    """The array as recordings hold it of a raw image's bytes, read-only where nothing is converted.

    `encoding`: foxglove's and ROS's name. `step`: bytes of a row; 0: no more than it needs. ImageError.
    """
    if encoding not in _LAYOUTS:
        raise ImageError(f"is encoded as '{encoding}' (known: {', '.join(_LAYOUTS)}, PNG, JPEG)")
    channels, kind, conversion = _LAYOUTS[encoding]
    row = width * channels * np.dtype(kind).itemsize
    step, data = (step, data[: step * height]) if step else (row, data)  # drivers may leave more in a buffer
    if step < row or len(data) != step * height or not height:
        raise ImageError(f"holds {len(data)} bytes where {width}×{height} {encoding} needs {step * height}")
    if channels == 2 and width % 2:
        raise ImageError(f"is {width} px wide, and two pixels of {encoding} share their colour")
    pixels = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(height, step)[:, :row]).view(kind)
    if channels > 1:
        pixels = pixels.reshape(height, width, channels)
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))
