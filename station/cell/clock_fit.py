"""A device's clock against this host's: offset, drift, and how sure they are."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ClockFit:
    """Line that `devices.clocks` fitted; `bound_s` holds for messages inside its window."""

    reference_s: float
    """Device time at which `offset_ns` holds."""
    offset_ns: float
    """Host monotonic minus device time."""
    drift: float
    """Host seconds per device second, minus 1."""
    drift_uncertainty: float
    latency_s: float
    residual_s: float = 0.0
    """The shortest delay of each tenth of the window lies within this above the line."""
    span_s: float = 0.0

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
