"""Read back the end of a file that was just written: its summary, its index, and the last chunk.

The strict scan proves all of a file, which takes minutes for gigabytes. Whoever sealed a session waits for
this only, and it is what a disk that fails at the end gets wrong.
"""

from __future__ import annotations

import zlib

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, MessageIndex

from recordings.mcap.records import (
    MAGIC,
    MESSAGE_HEAD,
    RECORD_HEAD,
    RECORD_LIMIT_BYTES,
    BadRecordError,
    parse,
    parse_chunk,
    split,
)
from recordings.mcap.source import ShortFileError, Source

_FOOTER_BYTES = 20


def check_ending(descriptor: int) -> None:
    """Prove summary, index and last chunk of a finished file. BadRecordError says what is wrong."""
    source = Source(descriptor)
    try:
        _check(source)
    except ShortFileError as error:
        raise BadRecordError("it is shorter than was written") from error


def _check(source: Source) -> None:
    end = source.size_bytes - len(MAGIC)
    footer_start = end - _FOOTER_BYTES - RECORD_HEAD.size
    if footer_start < len(MAGIC) or source.read(end, len(MAGIC)) != MAGIC:
        raise BadRecordError("the end mark is missing")
    opcode, length = RECORD_HEAD.unpack(source.read(footer_start, RECORD_HEAD.size))
    if (opcode, length) != (Opcode.FOOTER, _FOOTER_BYTES):
        raise BadRecordError("the footer is missing")
    footer = parse(Footer, source.read(footer_start + RECORD_HEAD.size, _FOOTER_BYTES))
    if not len(MAGIC) <= footer.summary_start <= footer_start:
        raise BadRecordError("the summary lies outside the file")
    summary = source.read(footer.summary_start, footer_start - footer.summary_start)
    covered = source.read(footer.summary_start, end - 4 - footer.summary_start)
    if zlib.crc32(covered) != footer.summary_crc:
        raise BadRecordError("the checksum of the summary does not fit its content")
    indexes = [(start, stop) for _, opcode, start, stop in split(summary) if opcode == Opcode.CHUNK_INDEX]
    if indexes:  # in the order of the file; an hour's session has tens of thousands
        start, stop = indexes[-1]
        _check_chunk(source, parse(ChunkIndex, summary[start:stop]))


def _check_chunk(source: Source, index: ChunkIndex) -> None:
    if index.chunk_length > RECORD_LIMIT_BYTES + RECORD_HEAD.size:
        raise BadRecordError("the last chunk is larger than any recording needs")
    chunk = source.read(index.chunk_start_offset, index.chunk_length)
    opcode, length = RECORD_HEAD.unpack_from(chunk)
    if (opcode, length) != (Opcode.CHUNK, index.chunk_length - RECORD_HEAD.size):
        raise BadRecordError("the index points to no chunk")
    _, records = parse_chunk(chunk[RECORD_HEAD.size :])
    messages: set[tuple[int, int, int]] = set()
    for place, opcode, start, stop in split(records):
        if opcode == Opcode.MESSAGE and stop - start >= MESSAGE_HEAD.size:
            channel, _, time_ns, _ = MESSAGE_HEAD.unpack_from(records, start)
            messages.add((channel, time_ns, place))
    places = source.read(index.chunk_start_offset + index.chunk_length, index.message_index_length)
    indexed: set[tuple[int, int, int]] = set()
    for _, opcode, start, stop in split(places):
        if opcode != Opcode.MESSAGE_INDEX:
            raise BadRecordError("no index of messages follows the last chunk")
        told = parse(MessageIndex, places[start:stop], exact=True)
        indexed |= {(told.channel_id, time_ns, place) for time_ns, place in told.records}
    if indexed != messages:
        raise BadRecordError("the index of the last chunk does not fit its messages")
