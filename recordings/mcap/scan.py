"""One pass over a whole file: structure and checksums are proven before anything is believed.

As tolerant as the specification: compressed chunks, messages outside chunks, checksums that were not
computed (0), absent summaries, records of unknown kinds. Damage is what contradicts a checksum or the
structure. The pass remembers where every message lies; one block of the file, or its largest chunk, is in
memory at a time.
"""

from __future__ import annotations

import hashlib
import os
from array import array
from collections.abc import Callable
from pathlib import Path

from recordings.errors import CorruptRecordingError, RecordingError, UnfinishedRecordingError, recover_line
from recordings.mcap import checksum
from recordings.mcap.contents import Contents
from recordings.mcap.records import (
    FOOTER,
    FOOTER_BYTES,
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    BadRecordError,
    Opcode,
    Statistics,
    TooLargeError,
    parse_chunk_head,
    parse_header,
    parse_statistics,
    split_records,
)
from recordings.mcap.source import ShortFileError, Source, unpack

CHUNK_LIMIT_BYTES = 40 * 1024 * 1024
"""Limit of a record, packed or unpacked: the largest image of a recording and a little more."""
SUMMARY_LIMIT_BYTES = 32 * 1024 * 1024
_BLOCK_BYTES = 256 * 1024
_AHEAD_BYTES = 64 * 1024
"""Read with a large record: what lies between it and the next one."""
_HEADER_LIMIT_BYTES = 64 * 1024
_FORBIDDEN = {Opcode.HEADER, Opcode.FOOTER, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX,
              Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET}  # fmt: skip
"""Known kinds that have no place among the data."""


def scan_file(
    descriptor: int, path: Path, rescue: str = "", progress: Callable[[int], None] = lambda bytes_done: None
) -> tuple[Contents, Source, str]:
    """Proves the open file → (what it holds, where to read it, its SHA-256).

    `rescue`: the command that saves what is whole, where it is not `recordings recover`. Raises
    UnfinishedRecordingError or CorruptRecordingError, naming the byte.
    """
    scan = _Scan(Source(descriptor), path, rescue or recover_line(path), progress)
    try:
        return scan.contents, scan.source, scan.run()
    except ShortFileError as error:
        text = f"{path} became shorter while it was read: another program changes it"
        raise CorruptRecordingError(
            text, code="changed-while-read", remedy="Try again afterwards."
        ) from error


class _Scan:
    def __init__(self, source: Source, path: Path, rescue: str, progress: Callable[[int], None]) -> None:
        self.source = source
        self._rescue = rescue
        self._progress = progress
        self.contents = Contents()
        self._path = path
        self._size = source.size_bytes
        self._data_limit = 0
        """No data record reaches over this byte."""
        self._base = 0
        self._block = b""
        """The file's bytes from `_base` on."""
        self._places: array[int] = array("q")
        """Places of message records in the block."""
        self._sha256 = hashlib.sha256()
        self._crc = 0

    def run(self) -> str:
        """Returns the SHA-256."""
        summary_start, summary_crc = self._tail()
        self._data_limit = summary_start or self._size - FOOTER_BYTES - len(MAGIC)
        position = len(MAGIC)
        try:
            position = self._header(position)
            while (end := self._data_record(position)) != position:
                position = end
            self._take(position)
        except TooLargeError as error:
            raise RecordingError(
                f"{self._path} has {error}, more than is read", code="too-large", remedy="Split it first."
            ) from error
        except BadRecordError as error:
            raise self._corrupt(position, str(error)) from error
        stored_crc, end = self._data_end(position)
        if stored_crc and stored_crc != self._crc:
            raise self._corrupt(position, "the checksum of the data section does not fit its content")
        if summary_start and end != summary_start:
            raise self._corrupt(position, "the data does not end where the footer says")
        rest = self.source.read(position, self._size - position)
        self._sha256.update(rest)
        summary = memoryview(rest)[end - position : -(FOOTER_BYTES + len(MAGIC))]
        if summary_start and summary_crc:
            covered = memoryview(rest)[end - position : -(len(MAGIC) + 4)]
            if checksum.crc32(covered) != summary_crc:
                raise self._corrupt(summary_start, "the checksum of the summary does not fit its content")
        try:
            self._summary(summary)
        except BadRecordError as error:
            raise self._corrupt(end, f"in the summary: {error}") from error
        return self._sha256.hexdigest()

    def _corrupt(self, offset: int, reason: str) -> CorruptRecordingError:
        return CorruptRecordingError(
            f"{self._path} is damaged at byte {offset}: {reason}",
            remedy=f"Use the original, or save what is whole: {self._rescue}",
            at_byte=offset,
        )

    def _unfinished(self, reason: str) -> UnfinishedRecordingError:
        text = f"{self._path} is unfinished or cut ({reason})"
        return UnfinishedRecordingError(text, remedy=f"Save what is whole: {self._rescue}")

    def _tail(self) -> tuple[int, int]:
        """Magic at both ends and the footer → (where the summary starts, 0 for none; its checksum)."""
        beginning = os.pread(self.source.descriptor, len(MAGIC), 0)
        if beginning != MAGIC:
            if not beginning:
                text = f"{self._path} is empty: it was never written, or its copy failed"
                raise CorruptRecordingError(text, code="empty-file", remedy="Copy it again.")
            if MAGIC.startswith(beginning):
                raise self._unfinished(f"only {self._size} bytes")
            raise self._corrupt(0, "it does not begin like an MCAP file, perhaps another one was meant")
        tail = FOOTER_BYTES + len(MAGIC)
        if self._size < len(MAGIC) + tail:
            raise self._unfinished(f"only {self._size} bytes")
        content = self.source.read(self._size - tail, tail)
        if not content.endswith(MAGIC):
            raise self._unfinished("the end mark is missing")
        opcode, length = RECORD_HEAD.unpack_from(content)
        if opcode != Opcode.FOOTER or length != FOOTER.size:
            raise self._unfinished("the footer is missing")
        summary_start, _, crc = FOOTER.unpack_from(content, RECORD_HEAD.size)
        if summary_start and not len(MAGIC) < summary_start <= self._size - tail:
            raise self._corrupt(self._size - tail, f"the footer points to byte {summary_start}")
        if summary_start and self._size - summary_start > SUMMARY_LIMIT_BYTES:
            raise self._corrupt(summary_start, "the summary is larger than any recording needs")
        return summary_start, crc

    def _at(self, position: int, length: int) -> int:
        """Loads these bytes; returns where they begin in the block. What was passed is taken in first."""
        if position + length > self._base + len(self._block):
            self._take(position)
            size = min(max(length + _AHEAD_BYTES, _BLOCK_BYTES), self._size - position)
            self._base, self._block = position, self.source.read(position, size)
        return position - self._base

    def _take(self, position: int) -> None:
        """Everything before `position` is done with: messages indexed, bytes counted into the checksums."""
        done = memoryview(self._block)[: position - self._base]
        if self._places:
            self.contents.add_messages(self._block, self._places, self._base)
            self._places = array("q")
        self._sha256.update(done)
        self._crc = checksum.crc32(done, self._crc)
        self._base, self._block = position, self._block[len(done) :]
        self._progress(position)

    def _header(self, position: int) -> int:
        self._base, self._block = 0, self.source.read(0, min(_BLOCK_BYTES, self._size))
        opcode, length = RECORD_HEAD.unpack_from(self._block, position)
        start = position + RECORD_HEAD.size
        if opcode != Opcode.HEADER or length > min(_HEADER_LIMIT_BYTES, self._data_limit - start):
            raise BadRecordError("the header is missing")
        self.contents.profile = parse_header(memoryview(self._block)[start : start + length])
        return start + int(length)

    def _data_record(self, position: int) -> int:
        """Takes in one record; returns where the next one starts, the same place at the data's end."""
        room = self._data_limit - position - RECORD_HEAD.size
        if room < 0:
            raise BadRecordError("a record head is cut")
        at = self._at(position, RECORD_HEAD.size)  # may load another block: before `_block` is named
        opcode, length = RECORD_HEAD.unpack_from(self._block, at)
        if length > room:
            raise BadRecordError(f"a record says it has {length} bytes, {room} are left")
        if length > CHUNK_LIMIT_BYTES:
            raise BadRecordError(f"a record of {length} bytes is larger than any recording needs")
        if opcode == Opcode.DATA_END:
            return position
        at = self._at(position, RECORD_HEAD.size + length)
        start, end = at + RECORD_HEAD.size, at + RECORD_HEAD.size + length
        content = memoryview(self._block)[start:end]
        if opcode == Opcode.CHUNK:
            self._chunk(at, end, content)
        elif opcode == Opcode.MESSAGE:
            if length < MESSAGE_HEAD.size:
                raise BadRecordError(f"a message of {length} bytes has no head")
            self._places.append(at)
        elif opcode == Opcode.SCHEMA:
            self.contents.add_schema(content)
        elif opcode == Opcode.CHANNEL:
            self.contents.add_channel(content)
        elif opcode == Opcode.ATTACHMENT:
            self.contents.add_attachment(content)
        elif opcode == Opcode.METADATA:
            self.contents.add_metadata(content)
        elif opcode in _FORBIDDEN or opcode == 0:
            raise BadRecordError(f"a record of kind 0x{opcode:02x} does not belong here")
        return position + RECORD_HEAD.size + int(length)

    def _chunk(self, at: int, end: int, content: memoryview) -> None:
        self.contents.chunks += 1
        head = parse_chunk_head(content)
        packed = content[head.data_offset :]
        if not head.compression:
            self._check(packed, head.uncompressed_size, head.crc)
            self._records(self._block, at + RECORD_HEAD.size + head.data_offset, end, self._places)
            return
        if head.uncompressed_size > CHUNK_LIMIT_BYTES:
            raise BadRecordError(f"a chunk unpacks to {head.uncompressed_size} bytes: more than is read here")
        records = unpack(packed, head.compression, head.uncompressed_size)
        self._check(memoryview(records), head.uncompressed_size, head.crc)
        offset = self._base + at + RECORD_HEAD.size + head.data_offset
        base = self.source.add_packed(offset, len(packed), head.compression, len(records))
        places: array[int] = array("q")
        self._records(records, 0, len(records), places)
        self.contents.add_messages(records, places, base)

    @staticmethod
    def _check(records: memoryview, size: int, crc: int) -> None:
        if size != len(records):
            raise BadRecordError(f"a chunk says it has {size} bytes, it has {len(records)}")
        if crc and checksum.crc32(records) != crc:
            raise BadRecordError("the chunk's checksum does not fit its content")

    def _records(self, buffer: bytes, position: int, end: int, places: array[int]) -> None:
        """Walks the records inside a chunk. It is the loop that runs once per message."""
        unpack_head, message = RECORD_HEAD.unpack_from, int(Opcode.MESSAGE)
        head_bytes, least = RECORD_HEAD.size, MESSAGE_HEAD.size
        while position < end:
            if end - position < head_bytes:
                raise BadRecordError(f"a record head is cut {end - position} bytes before the end of a chunk")
            opcode, length = unpack_head(buffer, position)
            start = position + head_bytes
            if length > end - start:
                raise BadRecordError(f"a record says it has {length} bytes, {end - start} are left")
            if opcode == message:
                if length < least:
                    raise BadRecordError(f"a message of {length} bytes has no head")
                places.append(position)
            elif opcode == Opcode.SCHEMA:
                self.contents.add_schema(memoryview(buffer)[start : start + length])
            elif opcode == Opcode.CHANNEL:
                self.contents.add_channel(memoryview(buffer)[start : start + length])
            elif opcode <= Opcode.DATA_END:
                raise BadRecordError(f"a record of kind 0x{opcode:02x} inside a chunk")
            position = start + length

    def _data_end(self, position: int) -> tuple[int, int]:
        """(stored checksum, where the record ends)."""
        length = RECORD_HEAD.unpack(self.source.read(position, RECORD_HEAD.size))[1]
        content = self.source.read(position + RECORD_HEAD.size, length)
        if length < 4:
            raise self._corrupt(position, "the end of the data has no checksum")
        return int.from_bytes(content[:4], "little"), position + RECORD_HEAD.size + length

    def _summary(self, summary: memoryview) -> None:
        stated: Statistics | None = None
        for _, opcode, content in split_records(summary):
            if opcode == Opcode.SCHEMA:
                self.contents.add_schema(content)
            elif opcode == Opcode.CHANNEL:
                self.contents.add_channel(content)
            elif opcode == Opcode.STATISTICS:
                stated = parse_statistics(content)
            elif opcode in (Opcode.HEADER, Opcode.MESSAGE, Opcode.CHUNK, Opcode.DATA_END):
                raise BadRecordError(f"a record of kind 0x{opcode:02x} does not belong here")
        if stated is not None and (difference := self.contents.differs(stated)):
            raise BadRecordError(difference)
