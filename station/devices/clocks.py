"""Fit of a device's clock to this host's monotonic clock, from the arrivals of its messages.

A message stamped at device time d arrives at host time d·(1 + drift) + offset + delay with delay ≥ 0. The
best line is the one that lies under all arrivals and is nearest to them: the edge of their lower convex
hull above the middle of the window (S. Moon, P. Skelly, D. Towsley, "Estimation and removal of clock skew
from network delay measurements", INFOCOM 1999). What no arrival can show, the shortest delay itself, goes
into the bound.
"""

from __future__ import annotations

import time
from collections import deque

import numpy as np
from numpy.typing import NDArray

from station.cell.clock_fit import ClockFit

Array = NDArray[np.float64]

BINS = 300
LEAST_BINS = 5
STRETCHES = 10
FIRST_BIN_S = 0.02
DRIFT_SPAN_S = 5.0
"""Over a shorter span no drift is fitted."""
DRIFT_LIMIT = 500e-6
"""Quartz clocks are far better; a steeper edge comes from too few arrivals."""
UNFITTED_DRIFT = 100e-6
REFIT_SHARE = 0.05
"""A fit stays the newest one until the span has grown by so much of it, or REFIT_S has passed."""
REFIT_S = 1.0


def monotonic_from_wall_ns(wall_ns: int) -> int:
    """Host monotonic time of a recent moment that the kernel stamped by the wall clock; never too early.

    A thread held up between reading the two clocks would be wrong by as much. The wall clock is read first,
    so such a stamp comes out too late, which a fit through the earliest arrivals overlooks; too early it
    would spoil the fit for a whole window.
    """
    age_ns = time.time_ns() - wall_ns
    return time.monotonic_ns() - age_ns


class ClockEstimator:
    """Feed it every arrival; memory and time per call are bounded.

    `window_s`: how far back arrivals count. `latency_s`: what is known of the shortest delay (half of the
    best round trip, for instance). A device time that goes back starts afresh: the device restarted.
    """

    def __init__(self, window_s: float = 300.0, latency_s: float = 0.0) -> None:
        self.latency_s = latency_s
        self._window_s = window_s
        self._bin_s = min(FIRST_BIN_S, window_s / BINS)
        self._bins: deque[tuple[float, float]] = deque()
        """(device time, smallest host − device in ns) of each stretch of time, oldest first."""
        self._bin_start_s = 0.0
        self._newest_s = 0.0
        self._fit: ClockFit | None = None

    def add(self, device_s: float, host_monotonic_ns: int) -> None:
        gap_ns = host_monotonic_ns - device_s * 1e9
        if self._bins and device_s < self._newest_s - self._bin_s:
            self._bins.clear()
            self._bin_s = min(FIRST_BIN_S, self._window_s / BINS)
            self._fit = None
        self._newest_s = device_s
        if not self._bins or device_s >= self._bin_start_s + self._bin_s:
            self._bins.append((device_s, gap_ns))
            self._bin_start_s = device_s
            while self._bins[0][0] < device_s - self._window_s:
                self._bins.popleft()
            if len(self._bins) > 2 * BINS:
                self._merge()
        elif gap_ns < self._bins[-1][1]:
            self._bins[-1] = (device_s, gap_ns)

    def _merge(self) -> None:
        """Pairs of bins become one: short bins are for the beginning, when there is little else."""
        bins = list(self._bins)
        pairs = [min(bins[i : i + 2], key=lambda b: b[1]) for i in range(0, len(bins), 2)]
        self._bins = deque(pairs)
        self._bin_s *= 2

    def fit(self) -> ClockFit | None:
        """The newest estimate; None before there is enough to say anything."""
        if len(self._bins) >= LEAST_BINS and not self._is_fresh(self._fit):
            self._fit = _estimate(np.array(self._bins), self._newest_s, self.latency_s)
        return self._fit

    def _is_fresh(self, fit: ClockFit | None) -> bool:
        return fit is not None and self._newest_s - fit.reference_s < min(REFIT_S, REFIT_SHARE * fit.span_s)


def _estimate(points: Array, newest_s: float, latency_s: float) -> ClockFit:
    """points: (n, 2), device time [s] and smallest host − device [ns] of each bin, oldest first."""
    device_s, gaps_ns = points.T
    span_s = float(device_s[-1] - device_s[0])
    drift, support = 0.0, int(gaps_ns.argmin())
    if span_s >= DRIFT_SPAN_S:
        drift, support = _supporting_line(points)
    line_ns = gaps_ns[support] + drift * (device_s - device_s[support]) * 1e9
    residual_s = _worst_best(gaps_ns - line_ns, device_s) / 1e9
    return ClockFit(
        reference_s=newest_s,
        offset_ns=float(gaps_ns[support] + drift * (newest_s - device_s[support]) * 1e9),
        drift=drift,
        residual_s=residual_s,
        drift_uncertainty=(
            UNFITTED_DRIFT if span_s < DRIFT_SPAN_S else min(UNFITTED_DRIFT, residual_s / span_s)
        ),
        latency_s=latency_s,
        span_s=span_s,
    )


def _supporting_line(points: Array) -> tuple[float, int]:
    """Slope (seconds per second) and a point (its row) of the lower hull's edge above the points' middle."""
    hull: list[int] = []
    rows = points.tolist()  # Python's floats: the chain is a loop
    for i, row in enumerate(rows):
        while len(hull) >= 2:
            (x0, y0), (x1, y1) = rows[hull[-2]], rows[hull[-1]]
            if (y1 - y0) * (row[0] - x0) < (row[1] - y0) * (x1 - x0):
                break
            hull.pop()  # on or above the line from the one before to this
        hull.append(i)
    right = max(1, int(np.searchsorted(points[hull, 0], points[:, 0].mean())))
    (d0, g0), (d1, g1) = rows[hull[right - 1]], rows[hull[right]]
    drift = (g1 - g0) / (d1 - d0) / 1e9
    if abs(drift) <= DRIFT_LIMIT:
        return drift, hull[right - 1]
    return 0.0, int(points[:, 1].argmin())


def _worst_best(above_ns: Array, device_s: Array) -> float:
    """The largest among the smallest values of each stretch of time: how well the line is held everywhere."""
    begin_s, end_s = device_s[0], device_s[-1]
    edges_s = np.linspace(begin_s, end_s, STRETCHES, endpoint=False)
    starts = np.unique(np.searchsorted(device_s, edges_s))
    return float(np.minimum.reduceat(above_ns, starts).max())
