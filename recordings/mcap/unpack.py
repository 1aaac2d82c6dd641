"""Compressed chunks, unpacked into a size that is known before: no file can grow in memory."""

from __future__ import annotations

import io

import lz4.frame
import zstandard

from recordings.mcap.records import BadRecordError

COMPRESSIONS = ("", "zstd", "lz4")
"""As the specification names them; '' is no compression."""
_WINDOW_LIMIT_BYTES = 64 * 1024 * 1024
"""Of zstd's look-back, which the packed data ask for."""


def unpack(packed: memoryview, compression: str, size_bytes: int) -> bytes:
    """Returns exactly `size_bytes`, which the caller has limited. BadRecordError for any other outcome."""
    try:
        if compression == "zstd":
            reader = zstandard.ZstdDecompressor(max_window_size=_WINDOW_LIMIT_BYTES).stream_reader(
                io.BytesIO(packed), read_across_frames=True
            )
            data: bytes = reader.read(size_bytes + 1)
        elif compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size_bytes + 1)
        else:
            raise BadRecordError(f"its compression '{compression[:20]}' is unknown (known: zstd, lz4)")
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise BadRecordError(f"a chunk cannot be unpacked ({error})") from error
    if len(data) != size_bytes:
        more = "more" if len(data) > size_bytes else str(len(data))
        raise BadRecordError(f"a chunk says it unpacks to {size_bytes} bytes, it gives {more}")
    return data
