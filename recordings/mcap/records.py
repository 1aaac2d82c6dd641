"""Records of an MCAP file as the library's types: every length is checked before it is believed.

The library itself returns a field that is cut, passes over the checksum of an attachment, and unpacks
whatever a chunk holds.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from typing import TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.records import Attachment, Chunk, McapRecord
from mcap.writer import MCAP0_MAGIC

MAGIC = MCAP0_MAGIC
RECORD_HEAD = struct.Struct("<BQ")
"""Opcode, length of the content."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time, publish time; the data follow."""
RECORD_LIMIT_BYTES = 40 * 1024 * 1024
"""Packed or unpacked: the largest image of a recording and a little more."""
_ZSTD_WINDOW_LIMIT_BYTES = 64 * 1024 * 1024
"""Look-back that packed data may ask for."""
R = TypeVar("R", bound=McapRecord)


class BadRecordError(ValueError):
    """A record that breaks the format; the message says how, the caller knows where."""


class TooLargeError(BadRecordError):
    """More than is read here, which bounds memory; the file may be whole."""


class _Fields(ReadDataStream):
    """The fields of one record, and nothing behind its end."""

    def __init__(self, content: bytes) -> None:
        super().__init__(io.BytesIO(content))
        self._size = len(content)

    def read(self, length: int) -> bytes:
        if length > self._size - self.count:
            raise BadRecordError(f"a field of {length} bytes reaches over the end of its record")
        return super().read(length)


def parse(kind: type[R], content: bytes, exact: bool = False) -> R:
    """The record of this kind. `exact`: no fields of later specifications may follow."""
    fields = _Fields(content)
    try:
        record: R = kind.read(fields)  # type: ignore[attr-defined]
    except UnicodeDecodeError as error:
        raise BadRecordError("a text is not valid UTF-8") from error
    if exact and fields.count != len(content):
        raise BadRecordError(f"{len(content) - fields.count} bytes are left over in a record")
    return record


def parse_attachment(content: bytes, exact: bool = False) -> Attachment:
    record = parse(Attachment, content, exact)
    texts = len(record.name.encode()) + len(record.media_type.encode())
    end = 8 + 8 + 4 + 4 + texts + 8 + len(record.data)
    (crc,) = struct.unpack_from("<I", content, end)
    if crc and zlib.crc32(content[:end]) != crc:
        raise BadRecordError(f"the checksum of attachment '{record.name[:40]}' does not fit")
    return record


def parse_chunk(content: bytes) -> tuple[Chunk, bytes]:
    """(the chunk, the records inside, unpacked and checked)."""
    chunk = parse(Chunk, content, exact=True)
    records, size = _unpacked(chunk), chunk.uncompressed_size
    if len(records) != size:
        more = "more" if len(records) > size else str(len(records))
        raise BadRecordError(f"a chunk says it unpacks to {size} bytes, it gives {more}")
    if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
        raise BadRecordError("the checksum of a chunk does not fit its content")
    return chunk, records


def _unpacked(chunk: Chunk) -> bytes:
    """At most one byte more than the chunk claims, which is within the limit."""
    size = chunk.uncompressed_size
    if size > RECORD_LIMIT_BYTES:
        raise BadRecordError(f"a chunk says it unpacks to {size} bytes: more than is read here")
    try:
        match chunk.compression:
            case "":
                return chunk.data
            case "zstd":
                packed = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW_LIMIT_BYTES)
                stream = packed.stream_reader(io.BytesIO(chunk.data), read_across_frames=True)
                return bytes(stream.read(size + 1))
            case "lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise BadRecordError(f"a chunk cannot be unpacked ({error})") from error
    raise BadRecordError(f"the compression '{chunk.compression[:20]}' is unknown (known: zstd, lz4)")


def split(records: bytes) -> Iterator[tuple[int, int, int, int]]:
    """(place, opcode, start and end of the content) of each record in a chunk or a summary."""
    place, size = 0, len(records)
    while place < size:
        start = place + RECORD_HEAD.size
        if start > size:
            raise BadRecordError(f"a record head is cut {size - place} bytes before the end")
        opcode, length = RECORD_HEAD.unpack_from(records, place)
        if length > size - start:
            raise BadRecordError(f"a record says it has {length} bytes, {size - start} are left")
        yield place, opcode, start, start + length
        place = start + length


def with_crc(content: dict[str, str]) -> dict[str, str]:
    """Metadata records have no checksum of their own in MCAP: ours carry one as an entry."""
    return content | {"crc32": _map_crc(content)}


def require_crc(content: dict[str, str]) -> None:
    """BadRecordError unless the entries are those that `with_crc` sealed."""
    if content.get("crc32") != _map_crc({k: v for k, v in content.items() if k != "crc32"}):
        raise BadRecordError("the checksum of a metadata record does not fit")


def _map_crc(content: dict[str, str]) -> str:
    return f"{zlib.crc32(repr(sorted(content.items())).encode()):08x}"
