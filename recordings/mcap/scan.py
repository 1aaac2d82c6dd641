"""One pass over a whole file: structure and checksums are proven before anything is believed.

As tolerant as the specification: compressed chunks, messages outside chunks, checksums that were not
computed (0), absent summaries, records of unknown kinds. Damage is what contradicts a checksum or the
structure. One record of the file is in memory at a time.
"""

from __future__ import annotations

import hashlib
import io
import zlib
from collections.abc import Callable
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import DataEnd, Footer, Header

from recordings.errors import CorruptRecordingError, RecordingError, UnfinishedRecordingError, recover_line
from recordings.mcap.contents import Contents
from recordings.mcap.records import (
    MAGIC,
    RECORD_HEAD,
    RECORD_LIMIT_BYTES,
    BadRecordError,
    TooLargeError,
    parse,
    parse_chunk,
)
from recordings.mcap.source import ShortFileError, Source

_TOLD_BYTES = 256 * 1024
"""Between two reports of progress."""
_IN_DATA = {
    *(Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX),
    *(Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END),
}
_IN_SUMMARY = {
    *(Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX),
    *(Opcode.STATISTICS, Opcode.SUMMARY_OFFSET, Opcode.FOOTER),
}


def scan_file(
    descriptor: int, path: Path, rescue: str = "", progress: Callable[[int], None] = lambda bytes_done: None
) -> tuple[Contents, Source, str]:
    """Proves the open file → (what it holds, where to read it, its SHA-256).

    `rescue`: the command that saves what is whole, where it is not `recordings recover`. Raises
    UnfinishedRecordingError or CorruptRecordingError, naming the byte.
    """
    scan = _Scan(Source(descriptor), progress)
    rescue = rescue or recover_line(path)
    try:
        return scan.contents, scan.source, scan.run()
    except _CutError as error:
        raise UnfinishedRecordingError(path=path, reason=str(error), rescue=rescue) from error
    except TooLargeError as error:
        raise RecordingError("too-large", path=path, excess=str(error)) from error
    except BadRecordError as error:
        if not scan.source.size_bytes:
            raise CorruptRecordingError("empty-file", path=path) from error
        advice = f"Use the original, or save what is whole: {rescue}"
        raise CorruptRecordingError(
            path=path, at_byte=scan.position, reason=str(error), advice=advice
        ) from error
    except ShortFileError as error:
        raise CorruptRecordingError("changed-while-read", path=path) from error


class _CutError(Exception):
    """The file has no end."""


class _Scan:
    def __init__(self, source: Source, progress: Callable[[int], None]) -> None:
        self.source = source
        self.contents = Contents()
        self.position = 0
        """Begin of the record that is looked at."""
        self._progress = progress
        self._file = io.BufferedReader(io.FileIO(source.descriptor, closefd=False), 256 * 1024)
        self._sha256 = hashlib.sha256()
        self._crc = 0
        """Checksum of the data section, then of the summary section."""
        self._summary_start = 0

    def run(self) -> str:
        """Returns the SHA-256."""
        self._check_ends()
        self._file.seek(0)
        self._read(len(MAGIC))
        opcode = 0
        while opcode != Opcode.FOOTER:
            self.position = self._file.tell()
            room = self.source.size_bytes - len(MAGIC) - self.position - RECORD_HEAD.size
            if room < 0:
                raise BadRecordError("a record head is cut")
            crc = self._crc
            opcode, length = RECORD_HEAD.unpack(self._read(RECORD_HEAD.size))
            if length > room or (opcode == Opcode.FOOTER and length != room):
                raise BadRecordError(f"a record says it has {length} bytes, {room} are left")
            if length > RECORD_LIMIT_BYTES:
                raise BadRecordError(f"a record of {length} bytes is larger than any recording needs")
            if (opcode == Opcode.HEADER) != (self.position == len(MAGIC)):
                raise BadRecordError("the header is missing, or not at the beginning")
            self._record(opcode, self._read(length), crc)
            if self.position // _TOLD_BYTES != (self.position + length) // _TOLD_BYTES:
                self._progress(self.position)
        self._progress(self.position)
        self._read(len(MAGIC))
        return self._sha256.hexdigest()

    def _check_ends(self) -> None:
        size = self.source.size_bytes
        beginning = self.source.read(0, min(len(MAGIC), size))
        if not beginning or not MAGIC.startswith(beginning):
            raise BadRecordError("it does not begin like an MCAP file, perhaps another one was meant")
        if size < 2 * len(MAGIC) or self.source.read(size - len(MAGIC), len(MAGIC)) != MAGIC:
            raise _CutError("the end mark is missing")

    def _read(self, length: int) -> bytes:
        """The next bytes of the file, counted into the hash and the checksum."""
        data = self._file.read(length)
        if len(data) < length:
            raise ShortFileError
        self._sha256.update(data)
        self._crc = zlib.crc32(data, self._crc)
        return data

    def _record(self, opcode: int, content: bytes, crc: int) -> None:
        """`crc`: of the section before the record."""
        known = opcode <= Opcode.DATA_END
        if known and opcode not in (_IN_SUMMARY if self._summary_start else _IN_DATA):
            raise BadRecordError(f"a record of kind 0x{opcode:02x} does not belong here")
        match opcode:
            case Opcode.MESSAGE:
                self.contents.add_message(self.position, content, 0, len(content))
            case Opcode.CHUNK:
                chunk, records = parse_chunk(content)
                offset = self.position + RECORD_HEAD.size
                if chunk.compression:
                    address = self.source.add_packed(offset, len(content), len(records))
                else:
                    address = offset + len(content) - len(records)
                self.contents.add_chunk(records, address)
            case Opcode.SCHEMA | Opcode.CHANNEL:
                self.contents.declare(opcode, content)
            case Opcode.ATTACHMENT:
                self.contents.add_attachment(content)
            case Opcode.METADATA:
                self.contents.add_metadata(content)
            case Opcode.HEADER:
                parse(Header, content)
            case Opcode.DATA_END:
                if parse(DataEnd, content).data_section_crc not in (0, crc):
                    raise BadRecordError("the checksum of the data section does not fit its content")
                self._summary_start, self._crc = self._file.tell(), 0
            case Opcode.FOOTER:
                footer = parse(Footer, content)
                if footer.summary_start not in (0, self._summary_start):
                    raise BadRecordError("the data does not end where the footer says")
                covered = RECORD_HEAD.pack(opcode, len(content)) + content[:-4]
                if footer.summary_start and footer.summary_crc not in (0, zlib.crc32(covered, crc)):
                    raise BadRecordError("the checksum of the summary does not fit its content")
