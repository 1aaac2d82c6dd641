"""The bytes of an open MCAP file by address, those inside compressed chunks as well.

A plain record's address is its place in the file. Unpacked chunks lie one after the other behind every
possible place in a file, so one number says where a message is; one unpacked chunk at a time is in memory.
"""

from __future__ import annotations

import io
import os
from array import array
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from recordings.mcap.records import MESSAGE_HEAD, RECORD_HEAD, BadRecordError

UNPACKED_START = 1 << 60
_WINDOW_BYTES = 64 * 1024
_BLOCK_RECORDS, _BLOCK_BYTES = 1024, 512 * 1024
_HEAD_BYTES = RECORD_HEAD.size + MESSAGE_HEAD.size
_ZSTD_WINDOW_LIMIT_BYTES = 64 * 1024 * 1024
"""Look-back that packed data may ask for."""


class Message(NamedTuple):
    """One message record."""

    time_ns: int
    sequence: int
    data: bytes


class ShortFileError(Exception):
    """The file became shorter after it was opened."""


class _Packed(NamedTuple):
    offset: int
    stored: int
    compression: str
    size: int


class Source:
    """Reads; never writes or closes. Usable from several threads."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.size_bytes = os.fstat(descriptor).st_size
        self._starts: list[int] = []
        self._packed: list[_Packed] = []
        self._next = UNPACKED_START
        self._unpacked: tuple[int, bytes] = (-1, b"")
        self._window: tuple[int, bytes] = (0, b"")

    def add_packed(self, offset: int, stored: int, compression: str, size: int) -> int:
        """Makes the compressed chunk data at `offset` readable; returns the address of its first byte."""
        start, self._next = self._next, self._next + size
        self._starts.append(start)
        self._packed.append(_Packed(offset, stored, compression, size))
        return start

    def read(self, address: int, length: int) -> bytes:
        """Returns exactly `length` bytes. Raises ShortFileError."""
        if address >= UNPACKED_START:
            start, data = self._chunk_at(address)
            return data[address - start : address - start + length]
        data = os.pread(self.descriptor, length, address)
        while len(data) < length:
            more = os.pread(self.descriptor, length - len(data), address + len(data))
            if not more:
                raise ShortFileError
            data += more
        return data

    def head(self, address: int) -> tuple[int, int, int]:
        """(length of the data, time in ns, sequence) of the message record at `address`."""
        raw = self.read(address, _HEAD_BYTES)
        _, sequence, time_ns, _ = MESSAGE_HEAD.unpack_from(raw, RECORD_HEAD.size)
        return RECORD_HEAD.unpack_from(raw)[1] - MESSAGE_HEAD.size, time_ns, sequence

    def message(self, address: int) -> Message:
        """Reads the message record at `address`. Raises ShortFileError."""
        start, window = self._window_at(address)
        at = address - start
        length = RECORD_HEAD.unpack_from(window, at)[1] - MESSAGE_HEAD.size
        _, sequence, time_ns, _ = MESSAGE_HEAD.unpack_from(window, at + RECORD_HEAD.size)
        at += _HEAD_BYTES
        if at + length <= len(window):
            return Message(time_ns, sequence, window[at : at + length])
        return Message(time_ns, sequence, self.read(address + _HEAD_BYTES, length))

    def beginning(self, address: int, length: int) -> Message:
        """Like `message`, with at most the first `length` bytes of its data."""
        size, time_ns, sequence = self.head(address)
        return Message(time_ns, sequence, self.read(address + _HEAD_BYTES, min(size, length)))

    def beginnings(self, addresses: array[int], length: int) -> Iterator[tuple[list[int], NDArray[np.uint8]]]:
        """Blocks of (addresses, (n, length) bytes that follow each record head); what lies outside is 0.

        Only of records in the file: it ends at the first that lies in a compressed chunk.
        """
        places = np.frombuffer(addresses, np.int64)
        while len(places) and places[0] < UNPACKED_START:
            block = places[:_BLOCK_RECORDS] - places[0]
            inside = (block >= 0) & (block < _BLOCK_BYTES)
            block = block[: len(block) if inside.all() else int(inside.argmin())]
            first = int(places[0]) + _HEAD_BYTES
            data = np.zeros(int(block[-1]) + length, np.uint8)
            raw = os.pread(self.descriptor, len(data), first)
            data[: len(raw)] = np.frombuffer(raw, np.uint8)
            yield places[: len(block)].tolist(), data[block[:, None] + np.arange(length)]
            places = places[len(block) :]

    def messages(self, addresses: Iterable[int]) -> Iterator[Message]:
        return map(self.message, addresses)

    def place(self, address: int) -> int:
        """The byte of the file, for people: of its chunk's data where that is compressed."""
        if address < UNPACKED_START:
            return address
        return self._packed[bisect_right(self._starts, address) - 1].offset

    def _window_at(self, address: int) -> tuple[int, bytes]:
        """(start, bytes) around a message's head: a block of the file, or a whole unpacked chunk."""
        if address >= UNPACKED_START:
            return self._chunk_at(address)
        start, window = self._window
        if not start <= address <= start + len(window) - _HEAD_BYTES:
            window = os.pread(self.descriptor, _WINDOW_BYTES, address)
            if len(window) < _HEAD_BYTES:
                raise ShortFileError
            start = address
            self._window = (start, window)
        return start, window

    def _chunk_at(self, address: int) -> tuple[int, bytes]:
        place = bisect_right(self._starts, address) - 1
        start, data = self._unpacked
        if start != self._starts[place]:
            start, packed = self._starts[place], self._packed[place]
            data = unpack(
                memoryview(self.read(packed.offset, packed.stored)), packed.compression, packed.size
            )
            self._unpacked = (start, data)
        return start, data


def unpack(packed: memoryview, compression: str, size_bytes: int) -> bytes:
    """Returns exactly `size_bytes`, which the caller has limited. BadRecordError for any other outcome."""
    try:
        if compression == "zstd":
            reader = zstandard.ZstdDecompressor(max_window_size=_ZSTD_WINDOW_LIMIT_BYTES).stream_reader(
                io.BytesIO(packed), read_across_frames=True
            )
            data: bytes = reader.read(size_bytes + 1)
        elif compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size_bytes + 1)
        else:
            raise BadRecordError(f"its compression '{compression[:20]}' is unknown (known: zstd, lz4)")
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise BadRecordError(f"a chunk cannot be unpacked ({error})") from error
    if len(data) != size_bytes:
        more = "more" if len(data) > size_bytes else str(len(data))
        raise BadRecordError(f"a chunk says it unpacks to {size_bytes} bytes, it gives {more}")
    return data
