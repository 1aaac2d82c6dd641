"""The bytes of an open MCAP file by address, those inside compressed chunks as well.

A plain record's address is its place in the file. Unpacked chunks lie one after the other behind every
possible place in a file, so one number says where a message is; one block at a time is in memory.
"""

from __future__ import annotations

import os
from bisect import bisect_right

from mcap.records import Message

from recordings.mcap.records import MESSAGE_HEAD, RECORD_HEAD, parse_chunk

UNPACKED_START = 1 << 60
"""Address of the first unpacked chunk: beyond the end of any file."""
_WINDOW_BYTES = 64 * 1024
"""Bytes of the file that are read at once."""
_HEAD_BYTES = RECORD_HEAD.size + MESSAGE_HEAD.size


class ShortFileError(Exception):
    """The file became shorter after it was opened."""


class Source:
    """Reads; never writes or closes. Usable from several threads."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.size_bytes = os.fstat(descriptor).st_size
        self._starts: list[int] = []
        """Addresses at which the chunks begin as if they were unpacked."""
        self._chunks: list[tuple[int, int]] = []
        """Of each its compressed content: (place in the file, length)."""
        self._next = UNPACKED_START
        self._block: tuple[int, bytes] = (0, b"")
        """What was read last: (address, bytes), a part of the file or a whole unpacked chunk."""

    def add_packed(self, offset: int, length: int, size_bytes: int) -> int:
        """Makes the compressed chunk at `offset` readable; returns the address of its first record."""
        start, self._next = self._next, self._next + size_bytes
        self._starts.append(start)
        self._chunks.append((offset, length))
        return start

    def read(self, place: int, length: int) -> bytes:
        """Returns exactly `length` bytes of the file. Raises ShortFileError."""
        data = os.pread(self.descriptor, length, place)
        while len(data) < length:
            more = os.pread(self.descriptor, length - len(data), place + len(data))
            if not more:
                raise ShortFileError
            data += more
        return data

    def sequence(self, address: int) -> int:
        """Sequence of the message record at this address."""
        at, block = self._around(address)
        return int(MESSAGE_HEAD.unpack_from(block, at + RECORD_HEAD.size)[1])

    def message(self, address: int) -> Message:
        """The message record at this address."""
        at, block = self._around(address)
        length = RECORD_HEAD.unpack_from(block, at)[1] - MESSAGE_HEAD.size
        channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(block, at + RECORD_HEAD.size)
        data = block[at + _HEAD_BYTES : at + _HEAD_BYTES + length]
        if len(data) < length:
            data = self.read(address + _HEAD_BYTES, length)
        return Message(channel, log_time, data, publish_time, sequence)

    def place(self, address: int) -> int:
        """The byte of the file, for people: of its chunk where that is compressed."""
        return address if address < UNPACKED_START else self._chunks[self._chunk_of(address)][0]

    def _chunk_of(self, address: int) -> int:
        return bisect_right(self._starts, address) - 1

    def _around(self, address: int) -> tuple[int, bytes]:
        """(where in the block the record begins, a block that holds at least its head)."""
        start, block = self._block
        if not start <= address <= start + len(block) - _HEAD_BYTES:
            if address < UNPACKED_START:
                start, block = address, os.pread(self.descriptor, _WINDOW_BYTES, address)
            else:
                number = self._chunk_of(address)
                start, block = self._starts[number], parse_chunk(self.read(*self._chunks[number]))[1]
            if len(block) < _HEAD_BYTES:
                raise ShortFileError
            self._block = (start, block)
        return address - start, block
