"""What the first bytes of an image say of it: its format, size and depth. Nothing is decoded, no library is
asked."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

IMAGE_LIMIT_BYTES = 36 * 1024 * 1024
"""Decoded size above which no image is read or written: bounds the reader's memory."""
SIDE_LIMIT_PX = 16384

LFS_POINTER = b"version https://git-lfs"
"""Beginning of what stands in a repository in place of a large file that was not fetched."""
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
TIFF_MAGICS = (b"II*\0", b"MM\0*")
_TIFF_WIDTH = 256
_TIFF_HEIGHT = 257
_TIFF_BITS = 258
_TIFF_CHANNELS = 277
_TIFF_ENTRY_BYTES = 12
_TIFF_KINDS = {3: "H", 4: "I"}
"""Kinds of whole numbers that tell sizes."""
_JPEG_SIZES = {0xC0, 0xC1, 0xC2}
"""Baseline, extended and progressive; the other start-of-frame kinds no camera writes."""

KEPT_FORMATS = ("png", "jpeg")
"""Files that recordings hold as they are."""


class ImageError(ValueError):
    """Bytes that are not the image they should be; says why."""


@dataclass(frozen=True)
class ImageHeader:
    format: str
    """png, jpeg, bmp, pgm or tiff"""
    width: int
    height: int
    channels: int
    """1 or 3, as it decodes"""
    bytes_per_sample: int

    @property
    def decoded_bytes(self) -> int:
        return self.width * self.height * self.channels * self.bytes_per_sample


def read_header(data: bytes) -> ImageHeader:
    """Size and depth from the first bytes, nothing decoded. Raises ImageError."""
    if data.startswith(_PNG_MAGIC):
        header = _png_header(data)
    elif data.startswith(b"\xff\xd8"):
        header = _jpeg_header(data)
    elif data.startswith(b"BM") and len(data) >= 30:
        width, height, _, bits = struct.unpack_from("<iiHH", data, 18)
        header = ImageHeader("bmp", abs(width), abs(height), 1 if bits <= 8 else 3, 1)
    elif match := re.match(rb"P5\s+(\d{1,6})\s+(\d{1,6})\s+(\d{1,5})\s", data[:64]):
        width, height, top = (int(g) for g in match.groups())
        header = ImageHeader("pgm", width, height, 1, 1 if top < 256 else 2)
    elif data.startswith(TIFF_MAGICS):
        header = _tiff_header(data)
    elif data.startswith(LFS_POINTER):
        raise ImageError("is a pointer of Git LFS: fetch the images with `git lfs pull`")
    else:
        raise ImageError("neither PNG, JPEG, BMP, PGM nor TIFF")
    if not (0 < header.width <= SIDE_LIMIT_PX and 0 < header.height <= SIDE_LIMIT_PX):
        raise ImageError(f"impossible size {header.width}×{header.height}")
    if header.decoded_bytes > IMAGE_LIMIT_BYTES:
        raise ImageError(
            f"{header.width}×{header.height} decodes to {header.decoded_bytes / 1e6:.0f} MB, "
            f"more than the {IMAGE_LIMIT_BYTES / 1e6:.0f} MB allowed"
        )
    return header


def _png_header(data: bytes) -> ImageHeader:
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise ImageError("the PNG has no header")
    width, height, depth, colour = struct.unpack_from(">IIBB", data, 16)
    channels = 1 if colour in (0, 4) else 3
    return ImageHeader("png", width, height, channels, 2 if depth == 16 else 1)


def _tiff_header(data: bytes) -> ImageHeader:
    """Of the first image of the file; its description may stand behind its pixels."""
    order = "<" if data.startswith(b"II") else ">"
    told = {_TIFF_BITS: 1, _TIFF_CHANNELS: 1}
    try:
        (at,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, at)
        for entry in range(at + 2, at + 2 + count * _TIFF_ENTRY_BYTES, _TIFF_ENTRY_BYTES):
            tag, kind, values = struct.unpack_from(f"{order}HHI", data, entry)
            if kind not in _TIFF_KINDS:
                continue
            form = _TIFF_KINDS[kind]
            place = entry + 8
            if values * struct.calcsize(form) > 4:  # behind an address, one for each channel
                (place,) = struct.unpack_from(f"{order}I", data, place)
            (told[tag],) = struct.unpack_from(f"{order}{form}", data, place)
        width, height = told[_TIFF_WIDTH], told[_TIFF_HEIGHT]
    except (struct.error, KeyError) as error:
        raise ImageError("the TIFF has no header, or is cut") from error
    channels = 1 if told[_TIFF_CHANNELS] == 1 else 3
    return ImageHeader("tiff", width, height, channels, 2 if told[_TIFF_BITS] > 8 else 1)


def _jpeg_header(data: bytes) -> ImageHeader:
    position = 2
    while position + 10 <= len(data):
        if data[position] != 0xFF:
            break
        marker = data[position + 1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker in _JPEG_SIZES:
            height, width, components = struct.unpack_from(">HHB", data, position + 5)
            return ImageHeader("jpeg", width, height, 1 if components == 1 else 3, 1)
        position += 2 + int(struct.unpack_from(">H", data, position + 2)[0])
    raise ImageError("the JPEG has no frame header")


def check_complete(data: bytes, header: ImageHeader) -> None:
    """Raises ImageError for a cut JPEG or PGM: their decoders fill what is missing with grey."""
    if header.format == "jpeg" and b"\xff\xd9" not in data[-64:]:
        raise ImageError("the JPEG is cut (no end marker)")
    if header.format == "pgm" and len(data) < header.decoded_bytes:
        raise ImageError("the PGM is cut")
