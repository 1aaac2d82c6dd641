"""Offset of a device's clock to this host's monotonic clock, from the arrivals of its messages.

A message stamped at device time d arrives at host time d + offset + delay with delay ≥ 0: the quickest one
of the last half minute gives the offset. What no arrival can show, the shortest delay itself, and what the
clocks can drift since then go into the bound.
"""

from __future__ import annotations

import time
from collections import deque

from station.cell.clock_fit import DRIFT, ClockFit

STRETCH_S, STRETCHES = 1.0, 30
"""The quickest message of each second is kept, for half a minute, in which clocks drift by 3 ms at most."""
LEAST_S = 0.1
"""Messages of a shorter time are too few to tell anything."""


def monotonic_from_wall_ns(wall_ns: int) -> int:
    """Host monotonic time of a recent moment that the kernel stamped by the wall clock; never too early.

    A thread held up between reading the two clocks would be wrong by as much. The wall clock is read first,
    so such a stamp comes out too late, which a fit through the earliest arrivals overlooks; too early it
    would spoil the fit for as long as it is kept.
    """
    age_ns = time.time_ns() - wall_ns
    return time.monotonic_ns() - age_ns


class ClockEstimator:
    """Feed it every arrival. A device time that goes back starts afresh: the device restarted."""

    def __init__(self, latency_s: float = 0.0) -> None:
        self.latency_s = latency_s
        """What is known of the shortest delay, such as half of the best round trip."""
        self._quickest: deque[tuple[float, float]] = deque(maxlen=STRETCHES)
        """(its begin in device time, s; least host − device time, ns) of each stretch, oldest first."""
        self._first_s = self._newest_s = 0.0

    def add(self, device_s: float, host_monotonic_ns: int) -> None:
        gap_ns = host_monotonic_ns - device_s * 1e9
        if device_s < self._newest_s:
            self._quickest.clear()
        if not self._quickest:
            self._first_s = device_s
        self._newest_s = device_s
        if not self._quickest or device_s >= self._quickest[-1][0] + STRETCH_S:
            self._quickest.append((device_s, gap_ns))
        elif gap_ns < self._quickest[-1][1]:
            self._quickest[-1] = (self._quickest[-1][0], gap_ns)

    def fit(self) -> ClockFit | None:
        """Return the newest estimate; None before there is enough to say anything."""
        if not self._quickest or self._newest_s - self._first_s < LEAST_S:
            return None
        begin_s, offset_ns = min(self._quickest, key=lambda stretch: stretch[1])
        age_s = self._newest_s - begin_s + STRETCH_S
        return ClockFit(self._newest_s, offset_ns, self.latency_s + DRIFT * age_s)
