"""News from the robot: how late they may be, and what made them late. Pure; knows no clock.

The one rule (docs/operator/safety.md). An arm is in motion from the moment that a move is sent until news
that came later say that it ended, and while a person guides it: `MOVING_S` without news end that. Otherwise
it rests, and late news are waited for up to `RESTING_S`: who decides decides on them, never on older ones.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from enum import StrEnum
from itertools import pairwise
from typing import NamedTuple

from recordings.schema.messages import RobotState
from station.cell.errors import StaleStateError
from station.devices.ur_condition import APPROVE_AGAIN

CURRENT_S = 0.1
"""News that are not older tell where the arm is now."""
MOVING_S = 0.25
RESTING_S = 1.0
TOLD_S = 0.3
"""News of a resting arm that were later than this are told of, with what made them late."""
SILENCE_S = 0.15
"""A silence that can have tripped the control program's watchdog (1/5 s, and ticks)."""


class Delay(StrEnum):
    """What came late. The values are the error's codes."""

    COMPUTER = "computer-late"
    CONTROLLER = "controller-late"
    NETWORK = "network-late"


class Evidence(NamedTuple):
    """What is known of the time before an arm was stopped."""

    pause_s: float
    """The longest time in which this computer did not kick the control program's watchdog; 0: it is not
    known, or does not matter."""
    gap_s: float
    """The longest time between the arrivals of two states, as the kernel stamped them."""
    clock_gap_s: float
    """How far the controller's clock went on in that time beyond the period of its states."""
    loopback: bool
    """No network lies between this computer and the controller."""

    @property
    def delay(self) -> Delay | None:
        """None: nothing was late for long enough to stop an arm.

        A busy computer holds up all three, so it is looked at first. A controller that was held up leaves
        states out; what a network holds up still comes.
        """
        if self.pause_s > max(SILENCE_S, self.gap_s / 2):
            return Delay.COMPUTER
        if self.gap_s <= SILENCE_S:
            return None
        if self.loopback or self.clock_gap_s > self.gap_s / 2:
            return Delay.CONTROLLER
        return Delay.NETWORK

    def error(self, effect: str = ": the arm was stopped") -> StaleStateError | None:
        """What a person is told; None without a delay."""
        pause_ms, gap_ms = 1000 * self.pause_s, 1000 * self.gap_s
        match self.delay:
            case Delay.COMPUTER:
                return StaleStateError(
                    f"this computer was busy for {pause_ms:.0f} ms{effect}",
                    code=Delay.COMPUTER,
                    remedy=f"End other programs on it, {APPROVE_AGAIN}.",
                    late_ms=pause_ms,
                )
            case Delay.CONTROLLER:
                return StaleStateError(
                    f"the robot's controller sent nothing for {gap_ms:.0f} ms{effect}",
                    code=Delay.CONTROLLER,
                    remedy=f"Look at the pendant, {APPROVE_AGAIN}.",
                    late_ms=gap_ms,
                )
            case Delay.NETWORK:
                return StaleStateError(
                    f"the network carried nothing from the robot for {gap_ms:.0f} ms{effect}",
                    code=Delay.NETWORK,
                    remedy=f"Check cable, switch and what else uses this network, {APPROVE_AGAIN}.",
                    late_ms=gap_ms,
                )
        return None


def largest_gap(
    history: Iterable[RobotState], since_s: float, until_s: float, period_s: float
) -> tuple[float, float]:
    """The longest time between two arrivals that ended within a span (host monotonic), and how much of it
    the controller's clock left out, seconds."""
    gaps = (
        ((b.host_monotonic_ns - a.host_monotonic_ns) / 1e9, b.controller_s - a.controller_s - period_s)
        for a, b in pairwise(state.stamps for state in history)
        if since_s < b.host_monotonic_ns / 1e9 <= until_s
    )
    return max(gaps, default=(0.0, 0.0))


def longest_silence_s(kicks_s: Iterable[float], since_s: float, until_s: float) -> float:
    """The longest time without a kick of the watchdog that began within a span, up to its end; 0: no kick."""
    inside = [kick_s for kick_s in kicks_s if since_s < kick_s < until_s]
    return max((b - a for a, b in pairwise([*inside, until_s])), default=0.0)


def is_loopback(host: str) -> bool:
    """An address of this very computer. A name may be anything: it is taken for another's."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
