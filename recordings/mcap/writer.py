"""Writes the MCAP format: chunks without compression, every checksum, indexes and statistics.

Source: the MCAP format specification, version 0 (mcap.dev/spec). Unlike the reference library's writer it
copies no picture and reads it once: large contents go from the caller's memory to the kernel. And it never
makes a good-looking file after a failed write: an OSError passes through, and the caller closes the file.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path

from recordings.files import create_exclusively
from recordings.mcap import checksum
from recordings.mcap.records import FOOTER, MAGIC, MESSAGE_HEAD, RECORD_HEAD, Opcode, Statistics

CHUNK_BYTES = 1024 * 1024
DECLARE_AGAIN_BYTES = 16 * 1024 * 1024
"""What lies between two copies of the declarations: a scan that lost one meets the next."""
LIBRARY = "calibration-station"
_LARGE_BYTES = 32 * 1024
Piece = bytes | bytearray | memoryview


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
        """Of chunks, attachments and metadata, in file order, for the summary."""
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
        if self._declared_at is None or self.size_bytes - self._declared_at > DECLARE_AGAIN_BYTES:
            self._declare()
        length = MESSAGE_HEAD.size + sum(map(len, pieces))
        self._chunk.note(channel, time_ns)
        head = RECORD_HEAD.pack(Opcode.MESSAGE, length)
        self._chunk.add(head + MESSAGE_HEAD.pack(channel, sequence & 0xFFFFFFFF, time_ns, time_ns))
        for piece in pieces:
            self._chunk.add(piece)
        if self._chunk.size_bytes > CHUNK_BYTES and not more:
            self.end_chunk()

    def _declare(self) -> None:
        """All schemas and channels so far, in a chunk of their own: damage elsewhere leaves them alone."""
        self.end_chunk()
        self._declared_at = self.size_bytes
        for pair in self._declarations:
            for record in pair:
                self._chunk.add(record)
        self.end_chunk()

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
        chunk, self._chunk = self._chunk, _Chunk()
        if not chunk.pieces:
            return
        start, crc = self.size_bytes, chunk.crc()
        head = chunk.head(crc)
        index_start = start + len(head) + chunk.size_bytes
        places, index = b"", b""
        for channel, entries in chunk.entries.items():
            self._per_channel[channel] = self._per_channel.get(channel, 0) + len(entries)
            places += struct.pack("<HQ", channel, index_start + len(index))
            packed = b"".join(struct.pack("<QQ", *entry) for entry in entries)
            index += _record(Opcode.MESSAGE_INDEX, struct.pack("<H", channel) + _sized(packed))
        file_crc = checksum.joined_crc(checksum.crc32(head, self._crc), crc, chunk.size_bytes)
        self._put([head, *chunk.pieces, index], checksum.crc32(index, file_crc))
        first, last = chunk.span_ns
        if chunk.entries:
            earliest, latest = self._span_ns or (first, last)
            self._span_ns = (min(earliest, first), max(latest, last))
        content = struct.pack("<QQQQ", first, last, start, index_start - start) + _sized(places)
        content += struct.pack("<Q", len(index)) + _text("")
        content += struct.pack("<QQ", chunk.size_bytes, chunk.size_bytes)
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
        rest = [memoryview(piece) for piece in pieces if len(piece)]
        if crc is None:
            crc = self._crc
            for piece in rest:
                crc = checksum.crc32(piece, crc)
        self._crc = crc
        while rest:
            done = os.writev(self.descriptor, rest)
            self.size_bytes += done
            while rest and done >= len(rest[0]):
                done -= len(rest.pop(0))
            if done:
                rest[0] = rest[0][done:]


class _Chunk:
    """Records on their way: small ones gathered, large pieces referred to."""

    def __init__(self) -> None:
        self.pieces: list[Piece] = []
        self.size_bytes = 0
        self.entries: dict[int, list[tuple[int, int]]] = {}
        """Channel → (time, offset) of its messages."""

    def add(self, piece: Piece) -> None:
        self.size_bytes += len(piece)
        if len(piece) >= _LARGE_BYTES:
            self.pieces.append(piece)
        elif self.pieces and isinstance(self.pieces[-1], bytearray):
            self.pieces[-1] += piece
        else:
            self.pieces.append(bytearray(piece))

    def note(self, channel: int, time_ns: int) -> None:
        """A message starts here."""
        self.entries.setdefault(channel, []).append((time_ns, self.size_bytes))

    @property
    def span_ns(self) -> tuple[int, int]:
        times = [time_ns for entries in self.entries.values() for time_ns, _ in entries]
        return (min(times), max(times)) if times else (0, 0)

    def crc(self) -> int:
        crc = 0
        for piece in self.pieces:
            crc = checksum.crc32(piece, crc)
        return crc

    def head(self, crc: int) -> bytes:
        """The chunk record up to its records."""
        content = struct.pack("<QQQI", *self.span_ns, self.size_bytes, crc) + _text("")
        content += struct.pack("<Q", self.size_bytes)
        return RECORD_HEAD.pack(Opcode.CHUNK, len(content) + self.size_bytes) + content


def _record(opcode: int, content: bytes) -> bytes:
    return RECORD_HEAD.pack(opcode, len(content)) + content


def _sized(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _text(value: str) -> bytes:
    return _sized(value.encode())


def _map(content: dict[str, str]) -> bytes:
    return _sized(b"".join(_text(key) + _text(value) for key, value in content.items()))
