"""Finds what is whole in a cut or damaged file: chunks, attachments and metadata with their checksums.

Nothing that no checksum vouches for is kept. After a damaged place the search goes on at the next whole
record. What the channels mean is gathered from everything that is whole, before any message is looked at.
"""

from __future__ import annotations

import errno
import os
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Header, Message, MessageIndex, Metadata, Schema

from recordings.mcap.contents import Contents
from recordings.mcap.records import (
    FOOTER_BYTES,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    RECORD_LIMIT_BYTES,
    BadRecordError,
    parse,
    parse_attachment,
    parse_chunk,
    require_crc,
    split,
)
from recordings.mcap.scan import SUMMARY_LIMIT_BYTES

_LIKE_A_RECORD = re.compile(
    rb"\x06.{4}\0{4}.{16}(?:(.{4}\0{4}).{4}\0{4}\1|.{12}(?:\x03\0{3}lz4|\x04\0{3}zstd))"
    rb"|\x09.{4}\0{4}.{16}[\x01-\x3c]\0{3}"
    rb"|\x0c.{4}\0{4}[\x01-\x3c]\0{3}",
    re.DOTALL,
)
"""Beginning of a chunk whose two sizes agree or that is compressed, an attachment, a metadata record.

Dark images are full of what looks like an opcode and a length.
"""
_PATTERN_BYTES = 49
"""Length of the longest beginning."""
_BLOCK_BYTES = 1024 * 1024
_DATA_END_BYTES = 4
_SAMPLES = 20
_SAMPLES_LIMIT_BYTES = 64 * 1024 * 1024

Identify = Callable[[list[bytes]], tuple[str, str, str, bytes] | None]
"""Messages of one channel → its topic, schema name, encoding and schema data, where only one kind fits."""


@dataclass
class Salvage:
    """Whole parts of a damaged file."""

    descriptor: int
    contents: Contents = field(default_factory=Contents)
    chunks: list[tuple[int, int]] = field(default_factory=list)
    """(place, length) of the content of each whole chunk."""
    lost_bytes: int = 0
    losses: list[str] = field(default_factory=list)
    """A sentence for each damaged place."""

    def lose(self, size_bytes: int, sentence: str) -> None:
        self.lost_bytes += size_bytes
        self.losses.append(sentence)

    def messages(self) -> Iterator[Message]:
        """Yield every message in file order; of channels that nobody declared, too."""
        for place, length in self.chunks:
            records = parse_chunk(os.pread(self.descriptor, length, place))[1]
            for _, opcode, start, end in split(records):
                if opcode == Opcode.MESSAGE:
                    channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(records, start)
                    data = records[start + MESSAGE_HEAD.size : end]
                    yield Message(channel, log_time, data, publish_time, sequence)


def salvage(descriptor: int, identify: Identify) -> Salvage:
    """Reads the whole open file; memory is bounded as in the strict reader.

    `identify` is asked about channels whose declarations are all lost.
    """
    found = _Walk(descriptor).run()
    _identify_channels(found, identify)
    return found


def _identify_channels(found: Salvage, identify: Identify) -> None:
    """Declares channels that messages name and no declaration speaks of, after what lies on them."""
    contents = found.contents
    samples: dict[int, list[bytes]] = {}
    sizes: dict[int, int] = {}
    sampled_bytes = 0
    for message in found.messages():
        number = message.channel_id
        if number not in contents.channels:
            kept = samples.setdefault(number, [])
            sizes[number] = sizes.get(number, 0) + len(message.data)
            if len(kept) < _SAMPLES and sampled_bytes < _SAMPLES_LIMIT_BYTES:
                kept.append(message.data)
                sampled_bytes += len(message.data)
    for number, kept in samples.items():
        if (known := identify(kept)) is None:
            found.lose(sizes[number], f"nothing says what the messages of channel {number} are")
            continue
        topic, name, encoding, data = known
        free = next(n for n in range(1, 2**16) if n not in contents.schemas)
        contents.schemas[free] = Schema(id=free, name=name, encoding=encoding, data=data)
        contents.channels[number] = Channel(number, topic, encoding, {}, free)


class _Walk:
    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._found = Salvage(descriptor)
        self._size = os.fstat(descriptor).st_size

    def run(self) -> Salvage:
        self._declarations_from_summary()
        position = len(MAGIC) if self._read(0, len(MAGIC)) == MAGIC else 0
        while position < self._size:
            try:
                opcode, content = self._content(position)
                if opcode == Opcode.DATA_END and len(content) == _DATA_END_BYTES:
                    break
                self._take(position + RECORD_HEAD.size, opcode, content)
                position += RECORD_HEAD.size + len(content)
            except BadRecordError as error:
                end = self._next_good(position + 1)
                self._found.lose(end - position, f"bytes {position} to {end}: {error}")
                position = end
        return self._found

    def _read(self, offset: int, length: int) -> bytes:
        return os.pread(self._descriptor, length, offset)

    def _content(self, position: int) -> tuple[int, bytes]:
        """(opcode, content) of the record here. BadRecordError when there is no whole one."""
        head = self._read(position, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            raise BadRecordError("the file ends inside a record")
        opcode, length = RECORD_HEAD.unpack(head)
        if length > self._size - position - RECORD_HEAD.size:
            raise BadRecordError("the file ends inside a record, or its length is damaged")
        if length > RECORD_LIMIT_BYTES:
            raise BadRecordError("the record's length is damaged")
        return opcode, self._read(position + RECORD_HEAD.size, length)

    def _take(self, place: int, opcode: int, content: bytes) -> None:
        """Takes in a record whose content is at `place`. BadRecordError where nothing proves it."""
        contents = self._found.contents
        records = _proven(opcode, content)
        if opcode == Opcode.CHUNK:
            self._declare(records)
            self._found.chunks.append((place, len(content)))
        elif opcode == Opcode.ATTACHMENT:
            contents.add_attachment(content)
        elif opcode == Opcode.METADATA:
            contents.add_metadata(content)

    def _declare(self, records: bytes) -> None:
        for _, opcode, start, end in split(records):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                with suppress(BadRecordError):  # declared before, differently: the first one counts
                    self._found.contents.declare(opcode, records[start:end])

    def _next_good(self, position: int) -> int:
        """The next place where a whole chunk, attachment or metadata record starts, or the file's end."""
        start = self._next_data(position)
        while start < self._size:
            block, at = self._read(start, _BLOCK_BYTES + _PATTERN_BYTES - 1), -1
            while (match := _LIKE_A_RECORD.search(block, at + 1)) is not None:
                at = match.start()
                with suppress(BadRecordError):
                    _proven(*self._content(start + at))
                    return start + at
            start = self._next_data(start + _BLOCK_BYTES)
        return self._size

    def _next_data(self, position: int) -> int:
        """Skip what was never written: a sparse file of many gigabytes may hold next to nothing."""
        try:
            return os.lseek(self._descriptor, position, os.SEEK_DATA)
        except OSError as error:  # EINVAL: this file system cannot tell
            return self._size if error.errno == errno.ENXIO else position

    def _declarations_from_summary(self) -> None:
        """A finished file repeats its channels at the end: they help when the chunk that had them is lost."""
        end = self._size - FOOTER_BYTES - len(MAGIC)
        tail = self._read(max(0, end), FOOTER_BYTES + len(MAGIC))
        if end < 0 or not tail.endswith(MAGIC):
            return
        footer = parse(Footer, tail[RECORD_HEAD.size : FOOTER_BYTES])
        if not 0 < footer.summary_start <= end or end - footer.summary_start > SUMMARY_LIMIT_BYTES:
            return
        summary = self._read(footer.summary_start, end - footer.summary_start)
        if zlib.crc32(tail[: FOOTER_BYTES - 4], zlib.crc32(summary)) == footer.summary_crc:
            with suppress(BadRecordError):
                self._declare(summary)


def _proven(opcode: int, content: bytes) -> bytes:
    """The records of a chunk, b"" of others. BadRecordError for what has no place here or no checksum."""
    match opcode:
        case Opcode.CHUNK:
            chunk, records = parse_chunk(content)
            if not chunk.uncompressed_crc:
                raise BadRecordError("the chunk has no checksum")
            for _, kind, start, end in split(records):
                if kind == Opcode.MESSAGE and end - start < MESSAGE_HEAD.size:
                    raise BadRecordError("a message has no head")
            return records
        case Opcode.ATTACHMENT:
            parse_attachment(content, exact=True)
        case Opcode.METADATA:
            require_crc(parse(Metadata, content, exact=True).metadata)
        case Opcode.MESSAGE_INDEX:
            parse(MessageIndex, content, exact=True)
        case Opcode.HEADER:
            parse(Header, content, exact=True)
        case _:
            raise BadRecordError(f"a record of kind 0x{opcode:02x} does not belong here")
    return b""
