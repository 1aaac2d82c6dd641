"""Writes the MCAP format: chunks without compression, every checksum, indexes and statistics.

Source: the MCAP format specification, version 0 (mcap.dev/spec). Unlike the reference library's writer it
copies no image and reads it once: large contents go from the caller's memory to the kernel. And it never
makes a good-looking file after a failed write: an OSError passes through, and the caller closes the file.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path

from recordings.files import create_exclusively
from recordings.mcap import checksum
from recordings.mcap.records import FOOTER, MAGIC, MESSAGE_HEAD, RECORD_HEAD, Opcode, Piece, Statistics

CHUNK_BYTES = 1024 * 1024
DECLARE_AGAIN_BYTES = 16 * 1024 * 1024
"""Distance of two copies of the declarations: a scan that lost one meets the next."""
LIBRARY = "calibration-station"
_LARGE_BYTES = 32 * 1024
_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<BQQQQIIQ")
"""A chunk's record without compression, up to its records."""
_CHUNK_INDEX_END = struct.Struct("<QIQQ")
_MESSAGE_INDEX = struct.Struct("<BQHI")
_PLACE = struct.Struct("<HQ")
_MESSAGE_OPCODE, _CHUNK_OPCODE = int(Opcode.MESSAGE), int(Opcode.CHUNK)
_MESSAGE_INDEX_OPCODE = int(Opcode.MESSAGE_INDEX)


class McapFile:
    """An open, locked file. Large message contents must not change before the chunk's end."""

    def __init__(self, path: Path) -> None:
        """Creates the empty file exclusively. RecordingError when that fails."""
        self.descriptor = create_exclusively(path)
        self.closed = False
        self.size_bytes = 0
        self._crc = 0
        self._declarations: list[tuple[bytes, bytes]] = []
        """(schema record, channel record) of channel 1, 2 …; the schema has the channel's number."""
        self._declared_at: int | None = None
        """Where the newest copy of all declarations is; None when it lacks some."""
        self._indexes: list[bytes] = []
        """Index records of chunks, attachments and metadata, in file order, for the summary."""
        self._counts = dict.fromkeys(Statistics._fields[:6], 0)
        self._per_channel: dict[int, int] = {}
        self._span_ns: tuple[int, int] | None = None
        self._chunk = _Chunk()

    def start(self, profile: str = "") -> None:
        """Writes the head; comes first."""
        self._put([MAGIC, _record(Opcode.HEADER, _text(profile) + _text(LIBRARY))])

    def register(
        self,
        topic: str,
        encoding: str,
        schema: tuple[str, str, bytes],
        metadata: dict[str, str] | None = None,
    ) -> int:
        """`schema`: name, encoding, data. Returns the channel's number."""
        number = len(self._declarations) + 1
        name, schema_encoding, data = schema
        schema_content = struct.pack("<H", number) + _text(name) + _text(schema_encoding) + _sized(data)
        channel_content = struct.pack("<HH", number, number) + _text(topic) + _text(encoding)
        pair = (
            _record(Opcode.SCHEMA, schema_content),
            _record(Opcode.CHANNEL, channel_content + _map(metadata or {})),
        )
        self._declarations.append(pair)
        self._declared_at = None
        self._counts["schemas"] += 1
        self._counts["channels"] += 1
        return number

    def message(
        self, channel: int, pieces: Sequence[Piece], time_ns: int, sequence: int, *, more: bool = False
    ) -> None:
        """A message whose content comes in pieces; ends the chunk when it is full.

        `more`: the next message belongs to this one and goes into the same chunk.
        """
        declares = self._declared_at is None or self.size_bytes - self._declared_at > DECLARE_AGAIN_BYTES
        if declares:
            self._declare()
        chunk = self._chunk
        chunk.message(channel, pieces, time_ns, sequence & 0xFFFFFFFF)
        if (declares or chunk.size_bytes > CHUNK_BYTES) and not more:
            self.end_chunk()

    def _declare(self) -> None:
        """Begins a chunk with all schemas and channels so far; one message follows and ends it.

        So damage elsewhere leaves them alone. Without a message the chunk's times would be 0, which viewers
        take for the recording's beginning.
        """
        self.end_chunk()
        self._declared_at = self.size_bytes
        for pair in self._declarations:
            for record in pair:
                self._chunk.add(record)

    def attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        content = struct.pack("<QQ", time_ns, time_ns) + _text(name) + _text(media_type)
        content += struct.pack("<Q", len(data)) + data
        record = _record(Opcode.ATTACHMENT, content + struct.pack("<I", checksum.crc32(content)))
        self.end_chunk()
        place = struct.pack("<QQQQQ", self.size_bytes, len(record), time_ns, time_ns, len(data))
        self._put([record])
        self._indexes.append(_record(Opcode.ATTACHMENT_INDEX, place + _text(name) + _text(media_type)))
        self._counts["attachments"] += 1

    def metadata(self, name: str, content: dict[str, str]) -> None:
        record = _record(Opcode.METADATA, _text(name) + _map(content))
        self.end_chunk()
        place = struct.pack("<QQ", self.size_bytes, len(record))
        self._put([record])
        self._indexes.append(_record(Opcode.METADATA_INDEX, place + _text(name)))
        self._counts["metadata"] += 1

    def end_chunk(self) -> None:
        """Hands the open chunk to the operating system, with the indexes of its messages."""
        chunk = self._chunk
        if not chunk.size_bytes:
            return
        self._chunk = _Chunk()
        start, size, crc, pieces = self.size_bytes, chunk.size_bytes, 0, chunk.pieces()
        for piece in pieces:
            crc = checksum.crc32(piece, crc)
        first, last = chunk.span_ns
        head = _CHUNK.pack(
            *(_CHUNK_OPCODE, _CHUNK.size - RECORD_HEAD.size + size, first, last, size, crc, 0, size)
        )
        index_start = start + len(head) + size
        places, index = b"", b""
        for channel, entries in chunk.entries.items():
            self._per_channel[channel] = self._per_channel.get(channel, 0) + len(entries) // 2
            places += _PLACE.pack(channel, index_start + len(index))
            length = 8 * len(entries)
            index += _MESSAGE_INDEX.pack(_MESSAGE_INDEX_OPCODE, 6 + length, channel, length)
            index += struct.pack(f"<{len(entries)}Q", *entries)
        file_crc = checksum.joined_crc(checksum.crc32(head, self._crc), crc, size)
        self._put([head, *pieces, index], checksum.crc32(index, file_crc))
        if chunk.entries:
            earliest, latest = self._span_ns or (first, last)
            self._span_ns = (min(earliest, first), max(latest, last))
        content = struct.pack("<QQQQ", first, last, start, index_start - start) + _sized(places)
        content += _CHUNK_INDEX_END.pack(len(index), 0, size, size)
        self._indexes.append(_record(Opcode.CHUNK_INDEX, content))
        self._counts["chunks"] += 1

    def finish(self) -> None:
        """Writes the summary and the end mark. Does not sync or close."""
        self.end_chunk()
        self._put([_record(Opcode.DATA_END, struct.pack("<I", self._crc))])
        start = self.size_bytes
        summary = b"".join(
            [
                *(schema for schema, _ in self._declarations),
                *(channel for _, channel in self._declarations),
                self._statistics(),
                *sorted(self._indexes, key=lambda record: record[0]),  # by kind; inside a kind as in the file
            ]
        )
        footer = RECORD_HEAD.pack(Opcode.FOOTER, FOOTER.size) + struct.pack("<QQ", start, 0)
        crc = checksum.crc32(footer, checksum.crc32(summary))
        self._put([summary, footer, struct.pack("<I", crc), MAGIC])

    def close(self) -> None:
        """Idempotent; what is in the open chunk is thrown away."""
        if not self.closed:
            self.closed = True
            os.close(self.descriptor)

    def _statistics(self) -> bytes:
        c = self._counts | {"messages": sum(self._per_channel.values())}
        fixed = struct.pack("<QHIIII", *(c[name] for name in Statistics._fields[:6]))
        pairs = b"".join(struct.pack("<HQ", *pair) for pair in self._per_channel.items())
        return _record(
            Opcode.STATISTICS, fixed + struct.pack("<QQ", *(self._span_ns or (0, 0))) + _sized(pairs)
        )

    def _put(self, pieces: Sequence[Piece], crc: int | None = None) -> None:
        """Everything, however often the kernel takes only a part. `crc`: the file's so far, when known."""
        if crc is None:
            crc = self._crc
            for piece in pieces:
                crc = checksum.crc32(piece, crc)
        self._crc = crc
        done = os.writev(self.descriptor, pieces)
        self.size_bytes += done
        if done < sum(map(len, pieces)):
            self._put_rest([memoryview(piece) for piece in pieces], done)

    def _put_rest(self, rest: list[memoryview], done: int) -> None:
        """`done`: bytes of it that the kernel has."""
        while rest:
            while rest and done >= len(rest[0]):
                done -= len(rest.pop(0))
            if rest:
                rest[0] = rest[0][done:]
                done = os.writev(self.descriptor, rest)
                self.size_bytes += done


class _Chunk:
    """Records on their way: small ones gathered in one buffer, large pieces referred to."""

    __slots__ = ("_buffer", "_large", "entries", "size_bytes", "span_ns")

    def __init__(self) -> None:
        self.size_bytes = 0
        self.span_ns = (0, 0)
        self.entries: dict[int, list[int]] = {}
        """Channel → time, offset, time, offset … of its messages."""
        self._buffer = bytearray()
        self._large: list[tuple[int, Piece]] = []
        """(where in the buffer it belongs, piece)."""

    def add(self, record: bytes) -> None:
        self.size_bytes += len(record)
        self._buffer += record

    def message(self, channel: int, pieces: Sequence[Piece], time_ns: int, sequence: int) -> None:
        first, last = self.span_ns if self.entries else (time_ns, time_ns)
        if not first < time_ns < last:
            self.span_ns = (min(first, time_ns), max(last, time_ns))
        entries = self.entries.get(channel)
        if entries is None:
            entries = self.entries[channel] = []
        entries += (time_ns, self.size_bytes)
        length = MESSAGE_HEAD.size
        for piece in pieces:
            length += len(piece)
        buffer = self._buffer
        buffer += _MESSAGE.pack(_MESSAGE_OPCODE, length, channel, sequence, time_ns, time_ns)
        for piece in pieces:
            if len(piece) >= _LARGE_BYTES:
                self._large.append((len(buffer), piece))
            else:
                buffer += piece
        self.size_bytes += RECORD_HEAD.size + length

    def pieces(self) -> list[Piece]:
        """Everything in its order; nothing may be added from now on."""
        small, start = memoryview(self._buffer), 0
        found: list[Piece] = []
        for end, piece in self._large:
            if end > start:
                found.append(small[start:end])
            found.append(piece)
            start = end
        if len(small) > start:
            found.append(small[start:])
        return found


def _record(opcode: int, content: bytes) -> bytes:
    return RECORD_HEAD.pack(opcode, len(content)) + content


def _sized(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _text(value: str) -> bytes:
    return _sized(value.encode())


def _map(content: dict[str, str]) -> bytes:
    return _sized(b"".join(_text(key) + _text(value) for key, value in content.items()))
