"""The records of an MCAP file: every length is checked before it is believed.

Source: the MCAP format specification, version 0 (mcap.dev/spec). A record may be longer than its fields:
later versions of the specification append new ones. `exact` refuses that, where a wrong length must not pass.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

from recordings.mcap import checksum

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
FOOTER = struct.Struct("<QQI")
_CHUNK_HEAD = struct.Struct("<QQQI")
FOOTER_BYTES = RECORD_HEAD.size + FOOTER.size

Piece = bytes | bytearray | memoryview


class Opcode(IntEnum):
    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


class BadRecordError(ValueError):
    """A record that breaks the format; the message says how, the caller knows where."""


class TooLargeError(BadRecordError):
    """More than is read here, which bounds memory; the file may be whole."""


class Schema(NamedTuple):
    id: int
    name: str
    encoding: str
    data: bytes


class Channel(NamedTuple):
    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: tuple[tuple[str, str], ...]


class ChunkHead(NamedTuple):
    uncompressed_size: int
    crc: int
    compression: str
    data_offset: int
    """Place of the records inside the chunk record's content."""


class Attachment(NamedTuple):
    name: str
    media_type: str
    data: bytes
    crc: int
    crc_covers: int
    """The checksum is of this many first bytes of the record's content."""


class Metadata(NamedTuple):
    name: str
    content: dict[str, str]


class Statistics(NamedTuple):
    messages: int
    schemas: int
    channels: int
    attachments: int
    metadata: int
    chunks: int
    start_ns: int
    end_ns: int
    channel_messages: dict[int, int]


class Cursor:
    """Reads fields off a record's content and never past its end."""

    def __init__(self, content: memoryview) -> None:
        self._content = content
        self.position = 0

    def bytes(self, length: int) -> memoryview:
        end = self.position + length
        if end > len(self._content):
            raise BadRecordError(f"a field of {length} bytes reaches over the end of its record")
        part = self._content[self.position : end]
        self.position = end
        return part

    def uint(self, size: int) -> int:
        return int.from_bytes(self.bytes(size), "little")

    def text(self) -> str:
        raw = self.bytes(self.uint(4))
        try:
            return str(raw, "utf-8")
        except UnicodeDecodeError as error:
            raise BadRecordError("a text is not valid UTF-8") from error

    def text_map(self) -> dict[str, str]:
        end = self.position + self.uint(4) + 4
        content: dict[str, str] = {}
        while self.position < end:
            key = self.text()
            if key in content:
                raise BadRecordError(f"the key '{key}' stands twice in one map")
            content[key] = self.text()
        if self.position != end:
            raise BadRecordError("a map does not end where it says")
        return content

    def end(self, exact: bool = True) -> None:
        """BadRecordError when bytes are left over and nothing may follow."""
        if exact and self.position != len(self._content):
            raise BadRecordError(f"{len(self._content) - self.position} bytes are left over in the record")


def parse_header(content: memoryview, exact: bool = False) -> str:
    """Returns the profile."""
    cursor = Cursor(content)
    profile, _ = cursor.text(), cursor.text()
    cursor.end(exact)
    return profile


def parse_schema(content: memoryview) -> Schema:
    cursor = Cursor(content)
    number, name, encoding = cursor.uint(2), cursor.text(), cursor.text()
    record = Schema(number, name, encoding, bytes(cursor.bytes(cursor.uint(4))))
    if record.id == 0:
        raise BadRecordError("schema 0 is not allowed")
    return record


def parse_channel(content: memoryview) -> Channel:
    cursor = Cursor(content)
    number, schema_id, topic, encoding = cursor.uint(2), cursor.uint(2), cursor.text(), cursor.text()
    return Channel(number, schema_id, topic, encoding, tuple(cursor.text_map().items()))


def parse_chunk_head(content: memoryview) -> ChunkHead:
    """Everything before the records; they must fill the rest of the content exactly."""
    cursor = Cursor(content)
    _, _, size, crc = _CHUNK_HEAD.unpack(cursor.bytes(_CHUNK_HEAD.size))
    compression = cursor.text()
    stored = cursor.uint(8)
    offset = cursor.position
    cursor.bytes(stored)
    cursor.end()
    return ChunkHead(size, crc, compression, offset)


def parse_attachment(content: memoryview, exact: bool = False) -> Attachment:
    cursor = Cursor(content)
    cursor.bytes(16)  # log time, creation time
    name, media_type = cursor.text(), cursor.text()
    data = bytes(cursor.bytes(cursor.uint(8)))
    covers = cursor.position
    record = Attachment(name, media_type, data, cursor.uint(4), covers)
    cursor.end(exact)
    return record


def parse_metadata(content: memoryview, exact: bool = False) -> Metadata:
    cursor = Cursor(content)
    record = Metadata(cursor.text(), cursor.text_map())
    cursor.end(exact)
    return record


def parse_statistics(content: memoryview) -> Statistics:
    cursor = Cursor(content)
    messages, schemas = cursor.uint(8), cursor.uint(2)
    channels, attachments, metadata, chunks = (cursor.uint(4) for _ in range(4))
    start, end = cursor.uint(8), cursor.uint(8)
    pairs = cursor.bytes(cursor.uint(4))
    if len(pairs) % 10:
        raise BadRecordError("the message counts do not end where they say")
    counts = dict(struct.iter_unpack("<HQ", pairs))
    return Statistics(messages, schemas, channels, attachments, metadata, chunks, start, end, counts)


def check_message_index(content: memoryview) -> None:
    """Nothing follows these, but a damaged chunk must not pass for one."""
    cursor = Cursor(content)
    cursor.uint(2)
    if len(cursor.bytes(cursor.uint(4))) % 16:
        raise BadRecordError("a message index does not end where it says")
    cursor.end()


def split_records(content: memoryview) -> Iterator[tuple[int, int, memoryview]]:
    """The records inside a chunk or a summary: (offset of the record, opcode, its content)."""
    position, end = 0, len(content)
    while position < end:
        if end - position < RECORD_HEAD.size:
            raise BadRecordError(f"a record head is cut {end - position} bytes before the end")
        opcode, length = RECORD_HEAD.unpack_from(content, position)
        start = position + RECORD_HEAD.size
        if length > end - start:
            raise BadRecordError(f"a record says it has {length} bytes, {end - start} are left")
        yield position, opcode, content[start : start + length]
        position = start + length


def with_crc(content: dict[str, str]) -> dict[str, str]:
    """Metadata records have no checksum of their own in MCAP: ours carry one as an entry."""
    return content | {"crc32": _map_crc(content)}


def require_crc(content: dict[str, str]) -> None:
    """BadRecordError unless the entries are those that `with_crc` sealed."""
    if content.get("crc32") != _map_crc({k: v for k, v in content.items() if k != "crc32"}):
        raise BadRecordError("the checksum of a metadata record does not fit")


def _map_crc(content: dict[str, str]) -> str:
    return f"{checksum.crc32(repr(sorted(content.items())).encode()):08x}"
