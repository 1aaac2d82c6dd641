"""The clocks of many messages at once: the loop over a recording's states is NumPy's, not Python's.

RobotState and PictureFacts begin with their `Stamps`; protobuf writes fields in their order and leaves out
zeros. A message that somebody wrote in another order is decoded one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.mcap import Source
from recordings.mcap.source import UNPACKED_START
from recordings.schema.messages import Stamps

_BLOCK_BYTES = 256 * 1024
_HEAD_BYTES = 31
"""Of a message record, before its data."""
_LONGEST_BYTES = 48
"""Of the stamps: a tag, a length, three numbers of at most 11 bytes, one of 9."""
_STAMPS_TAG, _VARINT, _DOUBLE = 0x0A, "varint", "double"
_FIELDS = ((0x08, _VARINT), (0x10, _VARINT), (0x19, _DOUBLE), (0x20, _VARINT))
Bytes = NDArray[np.uint8]
Places = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class StampsTable:
    """One row a message."""

    host_monotonic_ns: NDArray[np.int64]
    host_wall_ns: NDArray[np.int64]
    controller_s: NDArray[np.float64]
    device_ns: NDArray[np.int64]


DecodeOne = Callable[[int], Stamps]
"""The stamps of the message at this address, the slow way."""


def stamps_tables(
    source: Source, addresses: NDArray[np.uint64], decode_one: DecodeOne
) -> Iterator[StampsTable]:
    """Blocks in file order, each of a bounded size. Raises what `decode_one` raises."""
    first = 0
    while first < len(addresses):
        start = int(addresses[first])
        limit = start + _BLOCK_BYTES if start < UNPACKED_START else start + 1
        last = max(first + 1, int(np.searchsorted(addresses, np.uint64(limit))))
        chosen = addresses[first:last]
        length = int(chosen[-1]) - start + _HEAD_BYTES + _LONGEST_BYTES
        data = source.read(start, min(length, source.room(start)))
        buffer = np.frombuffer(data + bytes(_LONGEST_BYTES), np.uint8)
        yield _table(buffer, (chosen - chosen[0]).astype(np.int64) + _HEAD_BYTES, chosen, decode_one)
        first = last


def _table(
    buffer: Bytes, starts: Places, addresses: NDArray[np.uint64], decode_one: DecodeOne
) -> StampsTable:
    at, end = starts + 2, starts + 2 + buffer[starts + 1]
    good = (buffer[starts] == _STAMPS_TAG) & (end - starts <= _LONGEST_BYTES)
    columns: list[NDArray[np.int64]] = []
    for tag, kind in _FIELDS:
        there = (at < end) & (buffer[at] == tag) & good
        if kind == _VARINT:
            value, size = _varints(buffer, at + 1, there)
        else:
            value, size = _doubles(buffer, at + 1), np.full(len(at), 8)
        columns.append(np.where(there, value, 0))
        at = np.where(there, at + 1 + size, at)
    for row in np.flatnonzero(~good | (at != end)).tolist():
        for column, number in zip(columns, _numbers(decode_one(int(addresses[row]))), strict=True):
            column[row] = number
    return StampsTable(columns[0], columns[1], columns[2].view(np.float64), columns[3])


def _numbers(stamps: Stamps) -> tuple[int, int, int, int]:
    double = int(np.array(stamps.controller_s).view(np.int64))
    return stamps.host_monotonic_ns, stamps.host_wall_ns, double, stamps.device_ns


def _varints(buffer: Bytes, at: Places, there: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Places]:
    value, size, going = np.zeros(len(at), np.uint64), np.zeros(len(at), np.int64), there.copy()
    for shift in range(0, 70, 7):
        if not going.any():
            break
        byte = buffer[np.where(going, at + size, 0)]
        value |= np.where(going, (byte & 127).astype(np.uint64) << np.uint64(shift), np.uint64(0))
        size += going
        going &= byte > 127
    return value.view(np.int64), size


def _doubles(buffer: Bytes, at: Places) -> NDArray[np.int64]:
    inside = np.minimum(at, len(buffer) - 8)
    return np.ascontiguousarray(buffer[inside[:, None] + np.arange(8)]).view(np.int64)[:, 0]
