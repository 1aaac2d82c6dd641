"""How a device's clock lies against this host's monotonic clock, learnt from when its messages arrived.

A message stamped at device time d arrives at host time d·(1 + drift) + offset + delay with delay ≥ 0. The
best line is the one that lies under all arrivals and is nearest to them: the edge of their lower convex
hull above the middle of the window (S. Moon, P. Skelly, D. Towsley, "Estimation and removal of clock skew
from network delay measurements", INFOCOM 1999). What no arrival can show, the shortest delay itself, goes
into the bound.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

BINS = 300
LEAST_BINS = 5
STRETCHES = 10
FIRST_BIN_S = 0.02
DRIFT_SPAN_S = 5.0
"""Over a shorter span no drift is fitted."""
DRIFT_LIMIT = 500e-6
"""Quartz clocks are far better; a steeper edge comes from too few arrivals."""
UNFITTED_DRIFT = 100e-6


def monotonic_from_wall_ns(wall_ns: int) -> int:
    """Host monotonic time of a recent moment that the kernel stamped by the wall clock; never too early.

    A thread held up between reading the two clocks would be wrong by as much. The wall clock is read first,
    so such a stamp comes out too late, which a fit through the earliest arrivals overlooks; too early it
    would spoil the fit for a whole window.
    """
    age_ns = time.time_ns() - wall_ns
    return time.monotonic_ns() - age_ns


@dataclass(frozen=True)
class ClockFit:
    reference_s: float
    """Device time at which `offset_ns` holds."""
    offset_ns: float
    """Host monotonic minus device time."""
    drift: float
    """Host seconds per device second, minus 1."""
    residual_s: float
    """The shortest delay of each tenth of the window lies within this above the line."""
    drift_uncertainty: float
    latency_s: float
    samples: int
    span_s: float

    @property
    def drift_ppm(self) -> float:
        return self.drift * 1e6

    @property
    def offset_s(self) -> float:
        """At the newest device time."""
        return self.offset_ns / 1e9

    @property
    def bound_s(self) -> float:
        """95 % bound of the host time of a message inside the window."""
        return self.latency_s + self.residual_s + self.drift_uncertainty * self.span_s / 2

    def to_host_ns(self, device_s: float) -> int:
        return round(device_s * 1e9 + self.offset_ns + self.drift * (device_s - self.reference_s) * 1e9)

    def to_device_s(self, host_monotonic_ns: int) -> float:
        since_s = (host_monotonic_ns - self.offset_ns) / 1e9 - self.reference_s
        return self.reference_s + since_s / (1 + self.drift)


class ClockEstimator:
    """Feed it every arrival; memory and time per call are bounded. Usable from several threads.

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
        self._samples = 0
        self._fit: ClockFit | None = None
        self._fitted_bin_s = 0.0
        self._lock = threading.Lock()

    def add(self, device_s: float, host_monotonic_ns: int) -> None:
        gap_ns = host_monotonic_ns - device_s * 1e9
        with self._lock:
            if self._bins and device_s < self._newest_s - self._bin_s:
                self._forget()
            self._newest_s = device_s
            self._samples += 1
            if not self._bins or device_s >= self._bin_start_s + self._bin_s:
                self._bins.append((device_s, gap_ns))
                self._bin_start_s = device_s
                while self._bins[0][0] < device_s - self._window_s:
                    self._bins.popleft()
                if len(self._bins) > 2 * BINS:
                    self._merge()
            elif gap_ns < self._bins[-1][1]:
                self._bins[-1] = (device_s, gap_ns)

    def reset(self) -> None:
        with self._lock:
            self._forget()

    def _forget(self) -> None:
        self._bins.clear()
        self._bin_s = min(FIRST_BIN_S, self._window_s / BINS)
        self._samples, self._fit = 0, None

    def _merge(self) -> None:
        """Pairs of bins become one: short bins are for the beginning, when there is little else."""
        bins = list(self._bins)
        pairs = [min(bins[i : i + 2], key=lambda b: b[1]) for i in range(0, len(bins), 2)]
        self._bins = deque(pairs)
        self._bin_s *= 2

    def fit(self) -> ClockFit | None:
        """The newest estimate; None before there is enough to say anything."""
        with self._lock:
            if len(self._bins) < LEAST_BINS:
                return None
            if self._fit is None or self._fitted_bin_s != self._bin_start_s:
                self._fit = self._estimate(list(self._bins))
                self._fitted_bin_s = self._bin_start_s
            return self._fit

    def _estimate(self, points: list[tuple[float, float]]) -> ClockFit:
        span_s = points[-1][0] - points[0][0]
        if span_s < DRIFT_SPAN_S:
            drift, (at_s, gap_ns) = 0.0, min(points, key=lambda p: p[1])
        else:
            drift, (at_s, gap_ns) = _supporting_line(points)
        offset_ns = gap_ns + drift * (self._newest_s - at_s) * 1e9
        above = [(d, g - offset_ns - drift * (d - self._newest_s) * 1e9) for d, g in points]
        residual_s = _worst_best(above, points[0][0], span_s) / 1e9
        uncertainty = UNFITTED_DRIFT if span_s < DRIFT_SPAN_S else min(UNFITTED_DRIFT, residual_s / span_s)
        return ClockFit(
            reference_s=self._newest_s,
            offset_ns=offset_ns,
            drift=drift,
            residual_s=residual_s,
            drift_uncertainty=uncertainty,
            latency_s=self.latency_s,
            samples=self._samples,
            span_s=span_s,
        )


def _supporting_line(points: list[tuple[float, float]]) -> tuple[float, tuple[float, float]]:
    """Slope (seconds per second) and one point of the lower hull's edge above the middle of the points."""
    hull: list[tuple[float, float]] = []
    for p in points:
        while len(hull) >= 2 and _turns_right(hull[-2], hull[-1], p):
            hull.pop()
        hull.append(p)
    middle_s = sum(d for d, _ in points) / len(points)
    right = next(i for i, (d, _) in enumerate(hull) if d >= middle_s or i == len(hull) - 1)
    (d0, g0), (d1, g1) = hull[max(right, 1) - 1], hull[max(right, 1)]
    drift = (g1 - g0) / (d1 - d0) / 1e9
    if abs(drift) <= DRIFT_LIMIT:
        return drift, (d0, g0)
    return 0.0, min(points, key=lambda p: p[1])


def _worst_best(points: list[tuple[float, float]], begin_s: float, span_s: float) -> float:
    """The largest among the smallest values of each stretch of time: how well the line is held everywhere."""
    best: dict[int, float] = {}
    for d, value in points:
        stretch = min(STRETCHES - 1, int(STRETCHES * (d - begin_s) / span_s)) if span_s > 0 else 0
        best[stretch] = min(value, best.get(stretch, value))
    return max(best.values())


def _turns_right(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """b lies on or above the line a–c, so that it is not part of the lower hull."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])
