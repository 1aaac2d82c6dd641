"""One strict pass over a whole file: structure, checksums and counts are proven before anything is believed.

The pass also remembers where every message lies, so that reading is a matter of `pread` afterwards. One
chunk at a time is in memory.
"""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

from recordings import checksum
from recordings.contents import Contents
from recordings.errors import CorruptRecordingError, RecordingError, UnsealedRecordingError, recover_line
from recordings.pictures import PICTURE_LIMIT_BYTES
from recordings.records import (
    DATA_END_BYTES,
    FOOTER,
    FOOTER_BYTES,
    MAGIC,
    RECORD_HEAD,
    BadRecordError,
    Opcode,
    Statistics,
    check_message_index,
    parse_chunk_head,
    parse_header,
    parse_statistics,
    split_records,
)

CHUNK_LIMIT_BYTES = PICTURE_LIMIT_BYTES + 4 * 1024 * 1024
COMPRESSIONS = ("zstd", "lz4")
"""What other tools may have packed a recording with. Nothing here unpacks: no file can grow in memory."""
SUMMARY_LIMIT_BYTES = 32 * 1024 * 1024
_BLOCK_BYTES = 1024 * 1024
_UNCHECKED = {
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
}
"""Shortcuts for other readers; nothing here follows them."""


def scan_file(descriptor: int, path: Path) -> tuple[Contents, str]:
    """Proves the open file → (what it holds, its SHA-256).

    Raises UnsealedRecordingError or CorruptRecordingError, naming the byte.
    """
    return _Scan(descriptor, path).run()


def open_file(path: Path) -> int:
    """Descriptor for reading. RecordingError when it is no readable file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        raise RecordingError(f"cannot open {path}: {error.strerror}") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise RecordingError(f"{path} is not a file")
    return descriptor


class _Scan:
    def __init__(self, descriptor: int, path: Path) -> None:
        self._descriptor = descriptor
        self._path = path
        self._size = os.fstat(descriptor).st_size
        self._contents = Contents()

    def run(self) -> tuple[Contents, str]:
        summary_start, summary_crc = self._tail()
        data_end = summary_start - DATA_END_BYTES
        position = len(MAGIC)
        try:
            position = self._header(position)
            while position < data_end:
                position = self._data_record(position, data_end)
        except BadRecordError as error:
            raise self._corrupt(position, str(error)) from error
        sha256 = self._checksums(data_end, self._data_end(data_end), summary_start, summary_crc)
        try:
            stated = self._summary(summary_start)
        except BadRecordError as error:
            raise self._corrupt(summary_start, f"in the summary: {error}") from error
        self._check_counts(stated)
        return self._contents, sha256

    def _corrupt(self, offset: int, reason: str) -> CorruptRecordingError:
        return CorruptRecordingError(
            f"{self._path} is damaged at byte {offset}: {reason}. "
            f"Use the original, or save what is whole: {recover_line(self._path)}"
        )

    def _unsealed(self, reason: str) -> UnsealedRecordingError:
        return UnsealedRecordingError(
            f"{self._path} was not finished or is cut ({reason}). "
            f"Save what is whole: {recover_line(self._path)}"
        )

    def _read(self, offset: int, length: int) -> bytes:
        data = os.pread(self._descriptor, length, offset)
        while len(data) < length:
            more = os.pread(self._descriptor, length - len(data), offset + len(data))
            if not more:
                raise self._corrupt(offset, "the file became shorter while it was read")
            data += more
        return data

    def _tail(self) -> tuple[int, int]:
        """Magic at both ends and the footer → (where the summary starts, the summary's checksum)."""
        if self._size < len(MAGIC) or self._read(0, len(MAGIC)) != MAGIC:
            if self._size and MAGIC.startswith(self._read(0, min(self._size, len(MAGIC)))):
                raise self._unsealed(f"only {self._size} bytes")
            if not self._size:
                raise CorruptRecordingError(
                    f"{self._path} is empty: it was never written, or its copy failed. Copy it again"
                )
            raise self._corrupt(0, "it does not begin like an MCAP file, perhaps another one was meant")
        tail = FOOTER_BYTES + len(MAGIC)
        if self._size < 2 * len(MAGIC) + FOOTER_BYTES + DATA_END_BYTES:
            raise self._unsealed(f"only {self._size} bytes")
        content = self._read(self._size - tail, tail)
        if not content.endswith(MAGIC):
            raise self._unsealed("the end mark is missing")
        opcode, length = RECORD_HEAD.unpack_from(content)
        if opcode != Opcode.FOOTER or length != FOOTER.size:
            raise self._unsealed("the footer is missing")
        summary_start, _, crc = FOOTER.unpack_from(content, RECORD_HEAD.size)
        if not len(MAGIC) + DATA_END_BYTES <= summary_start <= self._size - tail:
            raise self._corrupt(self._size - tail, f"the footer points to byte {summary_start}")
        if self._size - tail - summary_start > SUMMARY_LIMIT_BYTES:
            raise self._corrupt(summary_start, "the summary is larger than any recording needs")
        return summary_start, crc

    def _header(self, position: int) -> int:
        opcode, length = RECORD_HEAD.unpack(self._read(position, RECORD_HEAD.size))
        if opcode != Opcode.HEADER or length > 4096:
            raise BadRecordError("the header is missing")
        start = position + RECORD_HEAD.size
        header = parse_header(memoryview(self._read(start, length)))
        if header.profile:
            raise BadRecordError(f"its profile is '{header.profile}': not a recording of this station")
        return start + int(length)

    def _data_record(self, position: int, end: int) -> int:
        """One record of the data section; returns where the next one starts."""
        if end - position < RECORD_HEAD.size:
            raise BadRecordError("a record head is cut")
        opcode, length = RECORD_HEAD.unpack(self._read(position, RECORD_HEAD.size))
        start = position + RECORD_HEAD.size
        if length > end - start:
            raise BadRecordError(f"a record says it has {length} bytes, {end - start} are left")
        if length > CHUNK_LIMIT_BYTES:
            raise BadRecordError(f"a record of {length} bytes is larger than any recording needs")
        content = memoryview(self._read(start, length))
        if opcode == Opcode.CHUNK:
            self._chunk(start, content)
        elif opcode == Opcode.ATTACHMENT:
            self._contents.add_attachment(content)
        elif opcode == Opcode.METADATA:
            self._contents.add_metadata(content)
        elif opcode == Opcode.MESSAGE_INDEX:
            check_message_index(content)
        else:
            raise BadRecordError(f"a record of kind 0x{opcode:02x} does not belong here")
        return start + int(length)

    def _chunk(self, start: int, content: memoryview) -> None:
        head = parse_chunk_head(content)
        if head.compression:
            raise BadRecordError(
                f"the chunk is compressed ('{head.compression[:20]}'), this station writes none"
            )
        records = content[head.data_offset :]
        if head.uncompressed_size != len(records):
            raise BadRecordError(f"a chunk says it has {head.uncompressed_size} bytes, it has {len(records)}")
        if checksum.crc32(records) != head.crc:
            raise BadRecordError("the chunk's checksum does not fit its content")
        base = start + head.data_offset
        for offset, opcode, inner in split_records(records):
            if opcode == Opcode.MESSAGE:
                self._contents.add_message(base + offset + RECORD_HEAD.size, inner)
            elif opcode == Opcode.SCHEMA:
                self._contents.add_schema(inner)
            elif opcode == Opcode.CHANNEL:
                self._contents.add_channel(inner)
            else:
                raise BadRecordError(f"a record of kind 0x{opcode:02x} inside a chunk")
        self._contents.chunks += 1

    def _data_end(self, position: int) -> int:
        record = self._read(position, DATA_END_BYTES)
        if RECORD_HEAD.unpack_from(record) != (Opcode.DATA_END, 4):
            raise self._corrupt(position, "the data does not end where the footer says")
        return int.from_bytes(record[RECORD_HEAD.size :], "little")

    def _checksums(self, data_end: int, stored_crc: int, summary_start: int, summary_crc: int) -> str:
        """One more pass in blocks: SHA-256 of the file, CRC of the data section and of the summary."""
        sha256, data_crc, end_crc = hashlib.sha256(), 0, 0
        summary_end = self._size - len(MAGIC) - 4
        for offset in range(0, self._size, _BLOCK_BYTES):
            block = memoryview(self._read(offset, min(_BLOCK_BYTES, self._size - offset)))
            sha256.update(block)
            if offset < data_end:
                data_crc = checksum.crc32(block[: data_end - offset], data_crc)
            if offset + len(block) > summary_start:
                part = block[max(0, summary_start - offset) : max(0, summary_end - offset)]
                end_crc = checksum.crc32(part, end_crc)
        if data_crc != stored_crc:
            raise self._corrupt(data_end, "the checksum of the data section does not fit its content")
        if end_crc != summary_crc:
            raise self._corrupt(summary_start, "the checksum of the summary does not fit its content")
        return sha256.hexdigest()

    def _summary(self, start: int) -> Statistics:
        end = self._size - FOOTER_BYTES - len(MAGIC)
        repeated = Contents()
        stated: Statistics | None = None
        for _, opcode, content in split_records(memoryview(self._read(start, end - start))):
            if opcode == Opcode.SCHEMA:
                repeated.add_schema(content)
            elif opcode == Opcode.CHANNEL:
                repeated.add_channel(content)
            elif opcode == Opcode.STATISTICS and stated is None:
                stated = parse_statistics(content)
            elif opcode not in _UNCHECKED:
                raise BadRecordError(f"a record of kind 0x{opcode:02x} does not belong here")
        if (repeated.schemas, repeated.channels) != (self._contents.schemas, self._contents.channels):
            raise BadRecordError("it declares other channels than the data")
        if stated is None:
            raise BadRecordError("it holds no statistics")
        return stated

    def _check_counts(self, stated: Statistics) -> None:
        found = self._contents.statistics()
        for name in Statistics._fields:
            says, has = getattr(stated, name), getattr(found, name)
            if says != has:
                raise self._corrupt(self._size, f"the statistics say {name} = {says}, the file has {has}")
