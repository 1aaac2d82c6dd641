"""Time of a frame: the middle of its exposure on the host's clock, with a bound and a source."""

from __future__ import annotations

from recordings.schema.messages import ClockReading, FrameTime, TimeSource
from station.cell.clock_fit import ClockFit

READINGS_KEPT = 200
UNKNOWN_READOUT_S = 0.05
"""Longest time from the end of an exposure to its first packet, where nothing else limits it."""


class DeviceClock:
    """A camera's clock, read over the wire. The bound holds whatever the delays there and back were."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        self._fresh: list[ClockReading] = []
        self.fit: ClockFit | None = None
        """By the reading that tells most about now; None before the first one."""

    def add(self, reading: ClockReading) -> None:
        """Keep a reading that is better than what the last good one still tells.

        One that does not agree with it begins anew: the clock was set or started again.
        """
        self._fresh = [*self._fresh[1 - READINGS_KEPT :], reading]
        half_ns = (reading.answered_monotonic_ns - reading.asked_monotonic_ns) / 2
        # Difference of integers first: stamps of 1.7e18 ns have no room in a float.
        offset_ns = float(reading.asked_monotonic_ns - reading.device_ns) + half_ns
        new, kept = ClockFit(reading.device_ns / 1e9, offset_ns, half_ns / 1e9), self.fit
        if kept is not None and new.reference_s >= kept.reference_s:
            still_s = kept.bound_at(new.reference_s)
            apart_s = abs(new.offset_ns - kept.offset_ns) / 1e9
            if still_s < new.bound_s and apart_s <= still_s + new.bound_s:
                return
        self.fit = new

    def take_fresh(self) -> tuple[ClockReading, ...]:
        """Readings that were not taken before, oldest first: each is recorded once."""
        fresh, self._fresh = tuple(self._fresh), []
        return fresh


def by_clock(start_device_ns: int, exposure_us: float, fit: ClockFit, source: TimeSource) -> FrameTime:
    """`start_device_ns`: the camera's clock at the start of the exposure."""
    device_s = start_device_ns / 1e9
    return FrameTime(fit.to_host_ns(device_s) + round(exposure_us * 500), fit.bound_at(device_s), source)


def by_trigger(fired_ns: int, fired_bound_s: float, exposure_us: float, arrival_ns: int) -> FrameTime:
    """Time a frame by the pulse of a trigger box.

    What the camera adds of its own is not known: the bound is all that lies between pulse and arrival.
    """
    left_s = (arrival_ns - exposure_us * 1000 - fired_ns) / 1e9
    return FrameTime(
        fired_ns + round(exposure_us * 500), max(fired_bound_s, fired_bound_s + left_s), "trigger"
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
