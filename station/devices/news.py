"""News (state messages) from the robot: how late they may be, and what delayed them. Pure functions.

The rule (docs/operator/safety.md): an arm counts as in motion from the moment that a move is sent until later
news say that it ended, and while a person guides it; it is stopped after `MOVING_S` without news. Otherwise
it rests, and late news are waited for up to `RESTING_S`. No decision is made on older news.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from enum import StrEnum
from itertools import pairwise
from typing import NamedTuple

from recordings.schema.messages import RobotState
from station.cell.errors import StaleStateError

CURRENT_S = 0.1
"""Largest age of news that count as the present state of the arm."""
MOVING_S = 0.25
RESTING_S = 1.0
REPORTED_S = 0.3
"""Delay of a resting arm's news above which the delay and its cause are reported."""
SILENCE_S = 0.15
"""Shortest silence that can have tripped the control program's watchdog (0.2 s less some cycles)."""


class Delay(StrEnum):
    """Cause of a delay; the values are error codes."""

    COMPUTER = "computer-late"
    CONTROLLER = "controller-late"
    NETWORK = "network-late"


class Evidence(NamedTuple):
    """Measurements of the time before an arm was stopped, from which the cause of a delay is derived."""

    pause_s: float
    """Longest time in which this computer did not reset the control program's watchdog; 0: not known, or
    irrelevant."""
    gap_s: float
    """Longest time between the arrivals of two states, by the kernel's stamps."""
    clock_gap_s: float
    """Advance of the controller's clock over that time, less the period of its states."""
    loopback: bool
    """True when the controller runs on this computer, with no network between."""

    @property
    def delay(self) -> Delay | None:
        """Derive the cause; None: no delay was long enough to stop an arm.

        A busy computer delays everything, so it is tested first. A busy controller skips states, a slow
        network only delays them.
        """
        if self.pause_s > max(SILENCE_S, self.gap_s / 2):
            return Delay.COMPUTER
        if self.gap_s <= SILENCE_S:
            return None
        if self.loopback or self.clock_gap_s > self.gap_s / 2:
            return Delay.CONTROLLER
        return Delay.NETWORK

    def error(self, effect: str = ": the arm was stopped") -> StaleStateError | None:
        """Make the error for people; None without a delay. `effect`: what followed from it."""
        if (delay := self.delay) is None:
            return None
        late_ms = 1000 * (self.pause_s if delay is Delay.COMPUTER else self.gap_s)
        return StaleStateError(delay.value, late_ms=late_ms, effect=effect)


def largest_gap(
    history: Iterable[RobotState], since_s: float, until_s: float, period_s: float
) -> tuple[float, float]:
    """Find the longest time (s) between two arrivals, the later one within a span (host monotonic).

    The second value is by how much more than a period the controller's clock advanced in it (s).
    """
    gaps = (
        ((b.host_monotonic_ns - a.host_monotonic_ns) / 1e9, b.controller_s - a.controller_s - period_s)
        for a, b in pairwise(state.stamps for state in history)
        if since_s < b.host_monotonic_ns / 1e9 <= until_s
    )
    return max(gaps, default=(0.0, 0.0))


def longest_silence_s(kicks_s: Iterable[float], since_s: float, until_s: float) -> float:
    """Find the longest time (s) without a reset of the watchdog that began in a span, or lasted to its end;
    0: there was no reset."""
    before = [kick_s for kick_s in kicks_s if kick_s < until_s]
    counted = [kick_s for kick_s in before if kick_s > since_s] or before[-1:]
    return max((b - a for a, b in pairwise([*counted, until_s])), default=0.0)


def is_loopback(host: str) -> bool:
    """Tell whether an address is a loopback one. A host name counts as another computer."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
