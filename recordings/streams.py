"""Clocks, rate and gaps of a recording's streams, in memory that does not grow with their length."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recordings.schema.clocks import DRIFT_SPAN_S, ClockEstimator
from recordings.schema.topics import Topic
from recordings.segment import RecordingSegment

_BATCH = 16_384
"""Messages whose clocks are in memory at once."""
_CLOCKS = np.dtype([("host_monotonic_ns", "i8"), ("controller_s", "f8"), ("device_ns", "i8")])
LARGEST_STAMP_S = 1e12
"""30 000 years: what is more, or no number, is no time."""
_BIN_SHIFT = 11
"""Shift of a float32's bits: bins of 1/4096 of their value."""
_SAMPLES = 65536
Times = NDArray[np.float64]


def stamps_tables(segment: RecordingSegment, topic: Topic) -> Iterator[NDArray[np.void]]:
    """Clocks of a topic's messages, many rows at once."""
    rows = map(_clocks, segment.parsed(topic))
    while len(table := np.fromiter(islice(rows, _BATCH), _CLOCKS)):
        yield table


def _clocks(message: Any) -> tuple[int, float, int]:
    stamps = message.stamps
    return stamps.host_monotonic_ns, stamps.controller_s, stamps.device_ns


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
