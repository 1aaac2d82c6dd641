"""Walks a cut or damaged file and finds every chunk whose checksum still proves it.

Nothing that no checksum vouches for is kept: a chunk is either whole or lost. After a damaged place the
search goes on at the next whole chunk. What the channels mean is gathered from everything that is whole,
before any message is looked at.
"""

from __future__ import annotations

import os
import re
import struct
from array import array
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field

from recordings.mcap import checksum
from recordings.mcap.contents import Contents, MessageIndex
from recordings.mcap.records import (
    FOOTER,
    FOOTER_BYTES,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    BadRecordError,
    Channel,
    ChunkHead,
    Opcode,
    Schema,
    check_message_index,
    parse_chunk_head,
    parse_header,
    parse_metadata,
    require_crc,
    split_records,
)
from recordings.mcap.scan import CHUNK_LIMIT_BYTES, SUMMARY_LIMIT_BYTES
from recordings.mcap.source import Source, unpack

_LIKE_A_RECORD = re.compile(rb"[\x06\x09\x0c].{4}\x00{4}", re.DOTALL)
"""Opcode of a chunk, attachment or metadata record, and a length below 4 GiB."""
_BLOCK_BYTES = 1024 * 1024
_DATA_END_LENGTH = 4
_PEEK_BYTES = 40
"""Length of an uncompressed chunk's content before its records."""
_CHUNK_PEEK = struct.Struct("<QIIQ")
"""Uncompressed size, checksum, length of the compression's name, stored size."""
_NAME_LIMIT = 60
_SMALL_RECORD_LIMIT_BYTES = 20 * 1024 * 1024
_SAMPLES = 20
_SAMPLES_LIMIT_BYTES = 64 * 1024 * 1024

Identify = Callable[[list[bytes]], tuple[str, str, str, bytes] | None]
"""Messages of one channel → its topic, schema name, encoding and schema data, where only one kind fits."""


@dataclass(frozen=True)
class Records:
    """The records inside one proven chunk."""

    address: int
    """Address in the source: records of a compressed chunk lie unpacked behind the file."""
    size_bytes: int


@dataclass
class Salvage:
    """Whole parts of a damaged file."""

    source: Source
    contents: Contents = field(default_factory=lambda: Contents(exact=True))
    chunks: list[Records] = field(default_factory=list)
    lost: list[tuple[int, int, str]] = field(default_factory=list)
    """(from byte, to byte, why)"""

    @property
    def lost_bytes(self) -> int:
        return sum(end - start for start, end, _ in self.lost)

    def records(self, chunk: Records) -> Iterator[tuple[int, int, memoryview]]:
        """(address, opcode, content) of each record."""
        data = memoryview(self.source.read(chunk.address, chunk.size_bytes))
        for place, opcode, content in split_records(data):
            yield chunk.address + place, opcode, content


def salvage(descriptor: int, identify: Identify = lambda samples: None) -> Salvage:
    """Reads the whole open file; memory is bounded as in the strict reader.

    `identify` is asked about channels whose declarations are all lost.
    """
    found = _Walk(descriptor).run()
    _identify_channels(found, identify)
    for chunk in found.chunks:
        _index_messages(found, chunk)
    return found


def _identify_channels(found: Salvage, identify: Identify) -> None:
    """Declares channels that messages name and no declaration speaks of, after what lies on them."""
    samples: dict[int, list[bytes]] = {}
    size_bytes = 0
    for chunk in found.chunks:
        for _, opcode, content in found.records(chunk):
            if opcode != Opcode.MESSAGE or len(content) < MESSAGE_HEAD.size:
                continue
            number = MESSAGE_HEAD.unpack_from(content)[0]
            if number in found.contents.channels:
                continue
            kept = samples.setdefault(number, [])
            if len(kept) < _SAMPLES and size_bytes < _SAMPLES_LIMIT_BYTES:
                kept.append(bytes(content[MESSAGE_HEAD.size :]))
                size_bytes += len(content)
    for number, kept in samples.items():
        if (known := identify(kept)) is not None:
            topic, name, encoding, data = known
            free = next(n for n in range(1, 2**16) if n not in found.contents.schemas)
            found.contents.schemas[free] = Schema(free, name, encoding, data)
            found.contents.channels[number] = Channel(number, free, topic, encoding, ())
            found.contents.messages[number] = MessageIndex()


def _index_messages(found: Salvage, chunk: Records) -> None:
    data = found.source.read(chunk.address, chunk.size_bytes)
    places: array[int] = array("q")
    for place, opcode, content in split_records(memoryview(data)):
        if opcode != Opcode.MESSAGE:
            continue
        if (
            len(content) >= MESSAGE_HEAD.size
            and MESSAGE_HEAD.unpack_from(content)[0] in found.contents.channels
        ):
            places.append(place)
        else:
            start = chunk.address + place
            end = start + RECORD_HEAD.size + len(content)
            found.lost.append((start, end, "nothing says what its channel carries"))
    try:
        found.contents.add_messages(data, places, chunk.address)
    except BadRecordError as error:
        found.lost.append((chunk.address, chunk.address + chunk.size_bytes, str(error)))


class _Walk:
    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._found = Salvage(Source(descriptor))
        self._size = self._found.source.size_bytes

    def run(self) -> Salvage:
        self._declarations_from_summary()
        position = 0
        if os.pread(self._descriptor, len(MAGIC), 0) == MAGIC:
            position = len(MAGIC)
        while position < self._size:
            try:
                end, last = self._record(position)
            except BadRecordError as error:
                end, last = self._next_good(position + 1), False
                self._found.lost.append((position, end, str(error)))
            position = self._size if last else end
        return self._found

    def _read(self, offset: int, length: int) -> bytes:
        return os.pread(self._descriptor, length, offset)

    def _content(self, position: int) -> tuple[int, memoryview]:
        """(opcode, content) of the record here. BadRecordError when there is no whole one."""
        head = self._read(position, RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            raise BadRecordError("the file ends inside a record")
        opcode, length = RECORD_HEAD.unpack(head)
        if length > self._size - position - RECORD_HEAD.size:
            raise BadRecordError("the file ends inside a record, or its length is damaged")
        if length > CHUNK_LIMIT_BYTES:
            raise BadRecordError("the record's length is damaged")
        return opcode, memoryview(self._read(position + RECORD_HEAD.size, length))

    def _record(self, position: int) -> tuple[int, bool]:
        """Takes in one record → (where the next one starts, whether the data section ended here)."""
        opcode, content = self._content(position)
        if opcode == Opcode.CHUNK:
            self._chunk(position + RECORD_HEAD.size, content)
        elif opcode == Opcode.ATTACHMENT:
            self._found.contents.add_attachment(content)
        elif opcode == Opcode.METADATA:
            require_crc(parse_metadata(content, exact=True).content)
            self._found.contents.add_metadata(content)
        elif opcode == Opcode.DATA_END and len(content) == _DATA_END_LENGTH:
            return position, True
        elif opcode == Opcode.MESSAGE_INDEX:
            check_message_index(content)
        elif opcode == Opcode.HEADER:
            parse_header(content, exact=True)
        else:
            raise BadRecordError(f"a record of kind 0x{opcode:02x} does not belong here")
        return position + RECORD_HEAD.size + len(content), False

    def _chunk(self, start: int, content: memoryview) -> None:
        head, records = _proven_records(content)
        for _ in split_records(records):
            pass  # its structure is sound before anything of it is taken in
        for _, opcode, inner in split_records(records):
            with suppress(BadRecordError):  # declared before, differently: the first one counts
                self._declare(opcode, inner)
        address = start + head.data_offset
        if head.compression:
            stored = len(content) - head.data_offset
            address = self._found.source.add_packed(address, stored, head.compression, len(records))
        self._found.chunks.append(Records(address, len(records)))

    def _declare(self, opcode: int, content: memoryview) -> None:
        if opcode == Opcode.SCHEMA:
            self._found.contents.add_schema(content)
        elif opcode == Opcode.CHANNEL:
            self._found.contents.add_channel(content)

    def _next_good(self, position: int) -> int:
        """The next place where a whole chunk, attachment or metadata record starts, or the file's end."""
        for candidate in self._candidates(position):
            try:
                opcode, content = self._content(candidate)
                if opcode == Opcode.CHUNK:
                    _proven_records(content)
                elif opcode == Opcode.ATTACHMENT:
                    Contents(exact=True).add_attachment(content)
                else:
                    require_crc(parse_metadata(content, exact=True).content)
            except BadRecordError:
                continue
            return candidate
        return self._size

    def _candidates(self, position: int) -> Iterator[int]:
        overlap = RECORD_HEAD.size
        for start in range(position, self._size, _BLOCK_BYTES):
            block = self._read(start, _BLOCK_BYTES + overlap)
            at = 0
            while (match := _LIKE_A_RECORD.search(block, at)) is not None and match.start() < _BLOCK_BYTES:
                if self._plausible(start + match.start()):
                    yield start + match.start()
                at = match.start() + 1

    def _plausible(self, position: int) -> bool:
        """Tell whether the first bytes fit the kind: dark images are full of what looks like records."""
        head = self._read(position, RECORD_HEAD.size + _PEEK_BYTES)
        if len(head) < RECORD_HEAD.size + _PEEK_BYTES:
            return False
        opcode, length = RECORD_HEAD.unpack_from(head)
        content = head[RECORD_HEAD.size :]
        if opcode == Opcode.CHUNK:
            size, _, name_length, stored = _CHUNK_PEEK.unpack_from(content, 16)
            if name_length:
                name = content[32 : 32 + name_length]
                return bool(name in (b"lz4", b"zstd") and size <= CHUNK_LIMIT_BYTES)
            return bool(size == stored == length - _PEEK_BYTES)
        (name_length,) = struct.unpack_from("<I", content, 16 if opcode == Opcode.ATTACHMENT else 0)
        return bool(0 < name_length <= _NAME_LIMIT and length <= _SMALL_RECORD_LIMIT_BYTES)

    def _declarations_from_summary(self) -> None:
        """A sealed file repeats its channels at the end: they help when the chunk that had them is lost."""
        tail = self._read(max(0, self._size - FOOTER_BYTES - len(MAGIC)), FOOTER_BYTES + len(MAGIC))
        if len(tail) < FOOTER_BYTES + len(MAGIC) or not tail.endswith(MAGIC):
            return
        start, offsets_start, crc = FOOTER.unpack_from(tail, RECORD_HEAD.size)
        end = self._size - FOOTER_BYTES - len(MAGIC)
        if not 0 < start <= end or end - start > SUMMARY_LIMIT_BYTES:
            return
        summary = self._read(start, end - start)
        if checksum.crc32(tail[: FOOTER_BYTES - 4], checksum.crc32(summary)) != crc or offsets_start > end:
            return
        with suppress(BadRecordError):
            for _, opcode, content in split_records(memoryview(summary)):
                self._declare(opcode, content)


def _proven_records(content: memoryview) -> tuple[ChunkHead, memoryview]:
    """(head, the records inside, unpacked) of a chunk whose checksum fits. BadRecordError otherwise."""
    head = parse_chunk_head(content)
    records = content[head.data_offset :]
    if head.uncompressed_size > CHUNK_LIMIT_BYTES:
        raise BadRecordError("the chunk's size is damaged, or more than is read here")
    if head.compression:
        records = memoryview(unpack(records, head.compression, head.uncompressed_size))
    if head.uncompressed_size != len(records) or checksum.crc32(records) != head.crc:
        raise BadRecordError("the chunk's checksum does not fit its content")
    return head, records
