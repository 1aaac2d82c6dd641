"""Walks a cut or damaged file and finds every chunk whose checksum still proves it.

Nothing that no checksum vouches for is kept: a chunk is either whole or lost. After a damaged place the
search goes on at the next whole chunk.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field

from recordings import checksum
from recordings.contents import Contents
from recordings.records import (
    FOOTER,
    FOOTER_BYTES,
    MAGIC,
    RECORD_HEAD,
    BadRecordError,
    Opcode,
    check_message_index,
    parse_chunk_head,
    parse_header,
    parse_metadata,
    require_crc,
    split_records,
)
from recordings.scan import CHUNK_LIMIT_BYTES, COMPRESSIONS, SUMMARY_LIMIT_BYTES

_LIKE_A_RECORD = re.compile(rb"[\x06\x09\x0c].{4}\x00{4}", re.DOTALL)
"""Opcode of a chunk, attachment or metadata record, and a length below 4 GiB."""
_BLOCK_BYTES = 1024 * 1024
_DATA_END_LENGTH = 4
_PEEK_BYTES = 40
"""Of an uncompressed chunk's content before its records."""
_CHUNK_PEEK = struct.Struct("<QIIQ")
"""Uncompressed size, checksum, length of the compression's name, stored size."""
_NAME_LIMIT = 60
_SMALL_RECORD_LIMIT_BYTES = 20 * 1024 * 1024


@dataclass
class Salvage:
    """What is whole in a damaged file."""

    contents: Contents = field(default_factory=Contents)
    chunks: list[tuple[int, int]] = field(default_factory=list)
    """(place in the file, length) of the records inside each good chunk."""
    lost: list[tuple[int, int, str]] = field(default_factory=list)
    """(from byte, to byte, why)"""

    @property
    def lost_bytes(self) -> int:
        return sum(end - start for start, end, _ in self.lost)


class CompressedError(Exception):
    """Somebody packed the file: it needs unpacking, not recovery."""


def salvage(descriptor: int) -> Salvage:
    """Reads the whole open file once; memory is bounded as in the strict reader. Raises CompressedError."""
    return _Walk(descriptor).run()


class _Walk:
    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._size = os.fstat(descriptor).st_size
        self._found = Salvage()

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
            require_crc(parse_metadata(content).content)
            self._found.contents.add_metadata(content)
        elif opcode == Opcode.DATA_END and len(content) == _DATA_END_LENGTH:
            return position, True
        elif opcode == Opcode.MESSAGE_INDEX:
            check_message_index(content)
        elif opcode == Opcode.HEADER:
            parse_header(content)
        else:
            raise BadRecordError(f"a record of kind 0x{opcode:02x} does not belong here")
        return position + RECORD_HEAD.size + len(content), False

    def _chunk(self, start: int, content: memoryview) -> None:
        records, offset = _proven_records(content)
        for _ in split_records(records):
            pass  # its structure is sound before anything of it is taken in
        for place, opcode, inner in split_records(records):
            position = start + offset + place
            try:
                self._take_in(position + RECORD_HEAD.size, opcode, inner)
            except BadRecordError as error:
                end = position + RECORD_HEAD.size + len(inner)
                self._found.lost.append((position, end, str(error)))
        self._found.chunks.append((start + offset, len(records)))

    def _take_in(self, start: int, opcode: int, content: memoryview) -> None:
        contents = self._found.contents
        if opcode == Opcode.MESSAGE:
            contents.add_message(start, content)
        elif opcode == Opcode.SCHEMA:
            contents.add_schema(content)
        elif opcode == Opcode.CHANNEL:
            contents.add_channel(content)

    def _next_good(self, position: int) -> int:
        """The next place where a whole chunk, attachment or metadata record starts, or the file's end."""
        for candidate in self._candidates(position):
            try:
                opcode, content = self._content(candidate)
                if opcode == Opcode.CHUNK:
                    _proven_records(content)
                elif opcode == Opcode.ATTACHMENT:
                    Contents().add_attachment(content)
                else:
                    require_crc(parse_metadata(content).content)
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
        """Whether the first bytes fit the kind: dark pictures are full of patterns that look like records."""
        head = self._read(position, RECORD_HEAD.size + _PEEK_BYTES)
        if len(head) < RECORD_HEAD.size + _PEEK_BYTES:
            return False
        opcode, length = RECORD_HEAD.unpack_from(head)
        content = head[RECORD_HEAD.size :]
        if opcode == Opcode.CHUNK:
            size, _, compression, stored = _CHUNK_PEEK.unpack_from(content, 16)
            return bool(compression == 0 and size == stored == length - _PEEK_BYTES)
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
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._take_in(0, opcode, content)


def _proven_records(content: memoryview) -> tuple[memoryview, int]:
    """(the records inside a chunk, their offset in it) when the checksum fits. BadRecordError otherwise."""
    head = parse_chunk_head(content)
    if head.compression in COMPRESSIONS:
        raise CompressedError
    records = content[head.data_offset :]
    if head.uncompressed_size != len(records) or checksum.crc32(records) != head.crc:
        raise BadRecordError("the chunk's checksum does not fit its content")
    return records, head.data_offset
