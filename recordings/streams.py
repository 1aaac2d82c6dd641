"""Clocks, rate and gaps of a recording's streams, in memory that does not grow with their length.

RobotState and PictureFacts begin with their `Stamps`, which are read many at once by NumPy. Protobuf writes
fields in their order and leaves out zeros; a message that somebody wrote otherwise is decoded alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.mcap.source import UNPACKED_START, Source
from recordings.schema.clocks import DRIFT_SPAN_S, ClockEstimator
from recordings.schema.messages import Stamps

_BLOCK_BYTES = 256 * 1024
_HEAD_BYTES = 31
"""Length of a message record before its data."""
_LONGEST_BYTES = 48
"""Limit of the stamps: a tag, a length, three numbers of at most 11 bytes, one of 9."""
_STAMPS_TAG, _VARINT, _DOUBLE = 0x0A, "varint", "double"
_FIELDS = ((0x08, _VARINT), (0x10, _VARINT), (0x19, _DOUBLE), (0x20, _VARINT))
LARGEST_STAMP_S = 1e12
"""30 000 years: what is more, or no number, is no time."""
_BIN_SHIFT = 11
"""Shift of a float32's bits: bins of 1/4096 of their value."""
_SAMPLES = 65536
Times = NDArray[np.float64]
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


class Steps:
    """The steps between stamps that follow each other, as a histogram with the sum of each bin."""

    def __init__(self) -> None:
        self.messages = 0
        self.count = 0
        """Steps."""
        self.backward = 0
        self._largest_s = 0.0
        bins = np.float32(np.inf).view(np.int32) >> _BIN_SHIFT
        self._counts = np.zeros(int(bins) + 1, np.int64)
        self._sums_s = np.zeros(int(bins) + 1)
        self._last_s: float | None = None

    def begin(self) -> None:
        """Begin another file: no step leads there."""
        self._last_s = None

    def add(self, stamps_s: Times) -> None:
        self.messages += len(stamps_s)
        good = stamps_s[np.abs(stamps_s) < LARGEST_STAMP_S]
        if not len(good):
            return
        steps = np.diff(good if self._last_s is None else np.append(self._last_s, good))
        self._last_s = float(good[-1])
        self.count += len(steps)
        self.backward += int((steps < 0).sum())
        forward = np.maximum(steps, 0.0)
        self._largest_s = max(self._largest_s, float(forward.max(initial=0.0)))
        bins = forward.astype(np.float32).view(np.int32) >> _BIN_SHIFT
        used, place = np.unique(bins, return_inverse=True)
        self._counts[used] += np.bincount(place)
        self._sums_s[used] += np.bincount(place, forward)

    def median_s(self) -> float:
        """Mean of the bin that holds the median: right to 1/4096, and exact where all steps are equal."""
        place = int(np.searchsorted(np.cumsum(self._counts), (self.count + 1) // 2))
        return float(self._sums_s[place] / self._counts[place])

    def longer_than(self, limit_s: float) -> tuple[int, float]:
        """(how many steps, the largest of them)."""
        first = (int(np.float32(limit_s).view(np.int32)) >> _BIN_SHIFT) + 1
        count = int(self._counts[first:].sum())
        return count, self._largest_s if count else 0.0


class Arrivals:
    """A device's clock against the host's: the drift that `ClockEstimator` finds, and the delays above it."""

    def __init__(self) -> None:
        self._clock = ClockEstimator(window_s=math.inf)
        self._sample = np.empty((0, 2))
        """(device, host minus device) of every `_every`th arrival, seconds."""
        self._latest: list[tuple[float, float]] = []
        """The same of the latest arrival of each block: over a block the line hardly moves."""
        self._every = 1

    def add(self, device_s: Times, host_monotonic_ns: NDArray[np.int64]) -> None:
        seen = (np.abs(device_s) < LARGEST_STAMP_S) & (device_s != 0) & (host_monotonic_ns != 0)
        device_s, host_ns = device_s[seen], host_monotonic_ns[seen]
        if not len(device_s):
            return
        self._clock.add_many(device_s, host_ns)
        gaps_s = host_ns / 1e9 - device_s
        late = int(gaps_s.argmax())
        self._latest.append((float(device_s[late]), float(gaps_s[late])))
        self._sample = np.vstack([self._sample, np.column_stack([device_s, gaps_s])[:: self._every]])
        while len(self._sample) > _SAMPLES:
            self._sample = self._sample[::2]
            self._every *= 2

    def fit(self) -> dict[str, float | None] | None:
        """None where a clock is missing or too little arrived; the drift is None over a short span.

        The spread is of arrivals above the line of the shortest delays: what a pairing can suffer.
        """
        fit = self._clock.fit()
        if fit is None:
            return None

        def above_ms(arrivals: Times) -> Times:
            line_s = fit.offset_ns / 1e9 + fit.drift * (arrivals[:, 0] - fit.reference_s)
            return np.maximum(arrivals[:, 1] - line_s, 0.0) * 1e3

        return {
            "drift_ppm": fit.drift_ppm if fit.span_s >= DRIFT_SPAN_S else None,
            "spread_p95_ms": float(np.percentile(above_ms(self._sample), 95)),
            "spread_max_ms": float(above_ms(np.array(self._latest)).max()),
        }
