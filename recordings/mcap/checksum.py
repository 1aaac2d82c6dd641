"""CRC-32 as zlib-ng computes it, in a quarter of the standard library's time (docs/decisions/0030)."""

from __future__ import annotations

from zlib_ng.zlib_ng import crc32
from zlib_ng.zlib_ng import crc32_combine as joined_crc

__all__ = ["crc32", "joined_crc"]
