"""A device's clock against this host's."""

from __future__ import annotations

from dataclasses import dataclass

DRIFT = 100e-6
"""Seconds per second that quartz clocks gain or lose at most. No drift is estimated: what it can do since the
last good reading goes into the bound, and arms stand still where the time counts."""


@dataclass(frozen=True)
class ClockFit:
    """Offset of a device's clock, as `devices.clocks` and `devices.frames` find it."""

    reference_s: float
    """Device time for which `bound_s` holds."""
    offset_ns: float
    """Host monotonic minus device time."""
    bound_s: float
    """95 % bound of a host time at `reference_s`."""

    def bound_at(self, device_s: float) -> float:
        """Bound (s) of the host time of a device time."""
        return self.bound_s + DRIFT * abs(device_s - self.reference_s)

    def to_host_ns(self, device_s: float) -> int:
        return round(device_s * 1e9 + self.offset_ns)

    def to_device_s(self, host_monotonic_ns: int) -> float:
        return (host_monotonic_ns - self.offset_ns) / 1e9
