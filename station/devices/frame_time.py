"""Time of a frame: the middle of its exposure on the host's clock, with a bound and a source."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from recordings.schema.messages import ClockReading, FrameTime, TimeSource
from station.cell.clock_fit import ClockFit
from station.devices.clocks import DRIFT_LIMIT, DRIFT_SPAN_S, UNFITTED_DRIFT

READINGS_KEPT = 200
UNKNOWN_READOUT_S = 0.05
"""Longest time from the end of an exposure to its first packet, where nothing else limits it."""


class _Reading(NamedTuple):
    device_s: float
    offset_ns: float
    """Host monotonic minus device time, at the middle of the round trip."""
    half_s: float
    """Half the round trip: the offset is wrong by this at most."""


class DeviceClock:
    """A camera's clock, read over the wire. The bound holds whatever the delays there and back were.

    The newest good reading gives the offset, the quickest ones early and late in the window the drift.
    """

    def __init__(self) -> None:
        self._readings: deque[_Reading] = deque(maxlen=READINGS_KEPT)
        self._fresh: list[ClockReading] = []

    def add(self, reading: ClockReading) -> None:
        """A reading that no earlier one agrees with begins anew: the clock was set or started again."""
        half_ns = (reading.answered_monotonic_ns - reading.asked_monotonic_ns) / 2
        # Difference of integers first: stamps of 1.7e18 ns have no room in a float.
        offset_ns = float(reading.asked_monotonic_ns - reading.device_ns) + half_ns
        new = _Reading(reading.device_ns / 1e9, offset_ns, half_ns / 1e9)
        if self._readings and _apart(self._readings[-1], new):
            self._readings.clear()
        self._readings.append(new)
        self._fresh = [*self._fresh[1 - READINGS_KEPT :], reading]

    def restart(self) -> None:
        self._readings.clear()
        self._fresh = []

    def take_fresh(self) -> tuple[ClockReading, ...]:
        """Readings that were not taken before, oldest first: each is recorded once."""
        fresh, self._fresh = tuple(self._fresh), []
        return fresh

    @property
    def fit(self) -> ClockFit | None:
        """By the round trips; None before the first reading."""
        readings = list(self._readings)
        return _by_round_trips(readings) if readings else None


def _apart(earlier: _Reading, later: _Reading) -> bool:
    """No drift that a quartz can have explains both."""
    passed_s = later.device_s - earlier.device_s
    apart_s = abs(later.offset_ns - earlier.offset_ns) / 1e9
    return passed_s < 0 or apart_s > earlier.half_s + later.half_s + DRIFT_LIMIT * passed_s


def _by_round_trips(readings: list[_Reading]) -> ClockFit:
    drift, doubt = _drift(readings)
    now_s = readings[-1].device_s
    best = min(readings, key=lambda r: r.half_s + doubt * (now_s - r.device_s))
    return ClockFit(best.device_s, best.offset_ns, drift, doubt, best.half_s)


def _drift(readings: list[_Reading]) -> tuple[float, float]:
    """Host seconds per device second minus 1, and how far it can be off."""
    span_s = readings[-1].device_s - readings[0].device_s
    third = max(1, len(readings) // 3)
    early, late = (min(part, key=lambda r: r.half_s) for part in (readings[:third], readings[-third:]))
    apart_s = late.device_s - early.device_s
    if span_s < DRIFT_SPAN_S or apart_s <= 0:
        return 0.0, UNFITTED_DRIFT
    doubt = (early.half_s + late.half_s) / apart_s
    if doubt >= UNFITTED_DRIFT:
        return 0.0, UNFITTED_DRIFT
    return (late.offset_ns - early.offset_ns) / 1e9 / apart_s, doubt


def by_clock(start_device_ns: int, exposure_us: float, fit: ClockFit, source: TimeSource) -> FrameTime:
    """`start_device_ns`: the camera's clock at the start of the exposure."""
    device_s = start_device_ns / 1e9
    beyond_s = fit.drift_uncertainty * abs(device_s - fit.reference_s)
    return FrameTime(fit.to_host_ns(device_s) + round(exposure_us * 500), fit.bound_s + beyond_s, source)


def by_trigger(
    fired_ns: int, fired_bound_s: float, delay_us: float, exposure_us: float, arrival_ns: int
) -> FrameTime:
    """Time a frame by the pulse of a trigger box and the camera's set delay after it.

    What the camera adds of its own is not known: the bound is all that lies between pulse and arrival.
    """
    start_ns = fired_ns + round(delay_us * 1000)
    left_s = (arrival_ns - exposure_us * 1000 - start_ns) / 1e9
    return FrameTime(
        start_ns + round(exposure_us * 500), max(fired_bound_s, fired_bound_s + left_s), "trigger"
    )


def by_arrival(
    arrival_ns: int, exposure_us: float, asked_ns: int | None = None, readout_s: float = UNKNOWN_READOUT_S
) -> FrameTime:
    """Time a frame by its first packet: the exposure began after it was asked for, and ended before.

    `asked_ns`: just before its trigger; None = not triggered, then `readout_s` is what can lie between.
    """
    exposure_ns = round(exposure_us * 1000)
    latest_ns = arrival_ns - exposure_ns
    earliest_ns = latest_ns - round(readout_s * 1e9) if asked_ns is None else min(asked_ns, latest_ns)
    middle_ns = (earliest_ns + latest_ns) // 2 + exposure_ns // 2
    return FrameTime(middle_ns, (latest_ns - earliest_ns) / 2e9, "arrival")
