"""Finds what is whole in a cut or damaged file: chunks, attachments and metadata with their checksums.

Only what a checksum proves is kept. After a damaged place the search goes on at the next record that
is whole.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Header, Message, MessageIndex, Metadata

from recordings.mcap.contents import Contents
from recordings.mcap.records import (
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    RECORD_LIMIT_BYTES,
    BadRecordError,
    parse,
    parse_chunk,
    require_crc,
    split,
)

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
_BLOCK_BYTES = 64 * 1024
_DATA_END_BYTES = 4
_SUMMARY_LIMIT_BYTES = 32 * 1024 * 1024
_SEAL_BYTES = 4 + len(MAGIC)
"""End of a file: the checksum of its summary, and the mark."""


@dataclass
class Salvage:
    """Whole parts of a damaged file."""

    descriptor: int
    contents: Contents = field(default_factory=Contents)
    chunks: dict[bytes, tuple[int, int]] = field(default_factory=dict)
    """Hash → (place, length) of the content of each whole chunk; one that stands there twice counts once."""
    lost_bytes: int = 0
    losses: list[str] = field(default_factory=list)
    """A sentence for each damaged place."""

    def lose(self, size_bytes: int, sentence: str) -> None:
        self.lost_bytes += size_bytes
        self.losses.append(sentence)

    def messages(self) -> Iterator[Message]:
        """Yield every message in file order; of channels that nobody declared, too."""
        for place, length in self.chunks.values():
            records = parse_chunk(os.pread(self.descriptor, length, place))[1]
            for _, opcode, start, end in split(records):
                if opcode == Opcode.MESSAGE:
                    channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(records, start)
                    data = records[start + MESSAGE_HEAD.size : end]
                    yield Message(channel, log_time, data, publish_time, sequence)

    def take(self, place: int, opcode: int, content: bytes) -> None:
        """Takes in a record whose content is at `place`. BadRecordError where nothing proves it."""
        match opcode:
            case Opcode.CHUNK:
                chunk, records = parse_chunk(content)
                heads = (end - start for _, kind, start, end in split(records) if kind == Opcode.MESSAGE)
                if not chunk.uncompressed_crc or min(heads, default=MESSAGE_HEAD.size) < MESSAGE_HEAD.size:
                    raise BadRecordError("the chunk has no checksum, or a message no head")
                self.declare(records)
                self.chunks.setdefault(hashlib.sha256(content).digest(), (place, len(content)))
            case Opcode.ATTACHMENT:
                self.contents.add_attachment(content, exact=True)
            case Opcode.METADATA:
                require_crc(parse(Metadata, content, exact=True).metadata)
                self.contents.add_metadata(content)
            case Opcode.MESSAGE_INDEX:
                parse(MessageIndex, content, exact=True)
            case Opcode.HEADER:
                parse(Header, content, exact=True)
            case _:
                raise BadRecordError(f"a record of kind 0x{opcode:02x} does not belong here")

    def declare(self, records: bytes) -> None:
        for _, opcode, start, end in split(records):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                with suppress(BadRecordError):  # declared before, differently: the first one counts
                    self.contents.declare(opcode, records[start:end])


def salvage(descriptor: int) -> Salvage:
    """Reads the whole open file; memory is bounded as in the strict reader."""
    found, size = Salvage(descriptor), os.fstat(descriptor).st_size
    position = len(MAGIC) if os.pread(descriptor, len(MAGIC), 0) == MAGIC else 0
    lost_from, why = -1, ""
    while position < size:
        try:
            opcode, content = _record(descriptor, position, size)
            if opcode == Opcode.DATA_END and len(content) == _DATA_END_BYTES:
                _declare_by_summary(found, position + RECORD_HEAD.size + _DATA_END_BYTES)
                break
            found.take(position + RECORD_HEAD.size, opcode, content)
        except BadRecordError as error:
            if lost_from < 0:
                lost_from, why = position, str(error)
            position = _next_candidate(descriptor, position + 1, size)
            continue
        if lost_from >= 0:
            found.lose(position - lost_from, f"bytes {lost_from} to {position}: {why}")
            lost_from = -1
        position += RECORD_HEAD.size + len(content)
    if lost_from >= 0:
        found.lose(position - lost_from, f"bytes {lost_from} to {position}: {why}")
    return found


def _record(descriptor: int, position: int, size: int) -> tuple[int, bytes]:
    """(opcode, content) of the record here. BadRecordError when there is no whole one."""
    head, rest = os.pread(descriptor, RECORD_HEAD.size, position), size - position - RECORD_HEAD.size
    if rest < 0:
        raise BadRecordError("the file ends inside a record")
    opcode, length = RECORD_HEAD.unpack(head)
    if length > min(rest, RECORD_LIMIT_BYTES):
        raise BadRecordError("the file ends inside a record, or its length is damaged")
    return opcode, os.pread(descriptor, length, position + RECORD_HEAD.size)


def _next_candidate(descriptor: int, position: int, size: int) -> int:
    """The next place where a chunk, an attachment or a metadata record may start, or the file's end."""
    while position < size:
        try:  # what was never written is skipped: a sparse file of many gigabytes may hold next to nothing
            position = os.lseek(descriptor, position, os.SEEK_DATA)
        except OSError as error:  # EINVAL: this file system cannot tell
            if error.errno == errno.ENXIO:
                return size
        block = os.pread(descriptor, _BLOCK_BYTES + _PATTERN_BYTES - 1, position)
        if match := _LIKE_A_RECORD.search(block):
            return position + match.start()
        position += _BLOCK_BYTES
    return size


def _declare_by_summary(found: Salvage, start: int) -> None:
    """A finished file repeats its channels at the end: they help when the chunk that had them is lost."""
    summary = os.pread(found.descriptor, _SUMMARY_LIMIT_BYTES, start)
    checked, crc, end = summary[:-_SEAL_BYTES], summary[-_SEAL_BYTES : -len(MAGIC)], summary[-len(MAGIC) :]
    if end == MAGIC and int.from_bytes(crc, "little") == zlib.crc32(checked):
        with suppress(BadRecordError):  # the last record, the footer, lacks its checksum here
            found.declare(checked)
