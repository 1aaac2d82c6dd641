"""Where the arm is and was: the one part that is asked for its state, and the rule how late that may be.

The rule is in `devices.news`. A state's age is the time since it arrived, by this computer's monotonic clock.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Sequence

from recordings.schema.messages import RobotState
from station.cell.clock_fit import ClockFit
from station.cell.errors import StaleStateError
from station.devices.history import state_at
from station.devices.news import CURRENT_S, MOVING_S, RESTING_S, Evidence, is_loopback, largest_gap
from station.devices.ur.stream import POLL_S, Sample, StateReader

log = logging.getLogger(__name__)


class ArmState:
    """The state of one arm, over all its connections.

    `in_motion` tells whether the arm counts as in motion, when its states may be late by less.
    """

    def __init__(self, host: str, in_motion: Callable[[], bool]) -> None:
        self._host = host
        self._in_motion = in_motion
        self.reader: StateReader | None = None
        """Reader of the state stream, with its counters; a new one after a lost connection."""
        self._newest: Sample | None = None
        """The newest sample, of this connection or an earlier one; None: none."""
        self._arrived_ns = 0
        """Its arrival (host monotonic); 0: none."""
        self.back_s = 0.0
        """When states came last after they had been late (host monotonic): what delayed them delayed all
        else, too."""
        self._subscribers: list[Callable[[RobotState], None]] = []

    async def open(self, on_lost: Callable[[str], None]) -> Sample:
        """Connect and return the first sample. Raises RobotError.

        `on_lost` is called once, with the reason, when the connection ends.
        """
        reader = self.reader = StateReader(self._host, self.deliver, on_lost)
        return await reader.open()

    def close(self) -> None:
        """Close the connection; its newest sample stays known, and grows old."""
        reader, self.reader = self.reader, None
        if reader is not None:
            reader.close()

    def forget(self) -> None:
        """Forget the newest sample."""
        self._newest, self._arrived_ns = None, 0

    def subscribe(self, callback: Callable[[RobotState], None]) -> None:
        """Call back with every state in order: the callback must be quick."""
        self._subscribers.append(callback)

    def deliver(self, state: RobotState) -> None:
        """Take the state that came now."""
        before_ns, self._arrived_ns = self._arrived_ns, state.stamps.host_monotonic_ns
        if self.reader is not None:
            self._newest = self.reader.newest
        if self._arrived_ns - before_ns > CURRENT_S * 1e9:
            self.back_s = time.monotonic()
        for callback in self._subscribers:
            try:
                callback(state)
            except Exception:
                log.exception("a subscriber of the robot's state failed and is dropped")
                self._subscribers = [s for s in self._subscribers if s is not callback]

    @property
    def connected(self) -> bool:
        """True while the state stream is connected; how old its newest state is, tells `age_s`."""
        return self.reader is not None and self.reader.ended is None and self.reader.newest is not None

    @property
    def version(self) -> str:
        """The controller's, empty before the first connection."""
        return ".".join(map(str, self.reader.version)) if self.reader is not None else ""

    def age_s(self) -> float:
        """Return the age of the newest sample whose controller time advanced.

        Waiting data are read first, so that a busy computer does not make news old.
        """
        if self.reader is not None and self._age_s() > CURRENT_S:
            self.reader.read()
        return self._age_s()

    def _age_s(self) -> float:
        return (time.monotonic_ns() - self._arrived_ns) / 1e9 if self._arrived_ns else float("inf")

    def sample(self, largest_age_s: float = CURRENT_S, *, connected: bool = True) -> Sample:
        """Return the newest sample; StaleStateError where it is older, or its controller time stands as long.

        `connected`: the connection must live; False: a sample of one that ended will do, too.
        """
        age_s = self.age_s()
        if self._newest is None or age_s > largest_age_s or (connected and not self.connected):
            raise self._stale(age_s, largest_age_s)
        return self._newest

    def overdue(self) -> StaleStateError | None:
        """Name why a late state is waited for no longer: at once where the connection of an arm in motion
        ended."""
        in_motion = self._in_motion()
        try:
            self.sample(MOVING_S if in_motion else RESTING_S, connected=in_motion)
        except StaleStateError as error:
            return error
        return None

    async def state_after(self, moment_s: float, wait_s: float) -> RobotState | None:
        """Wait for a state younger than a moment (host monotonic); None: none within `wait_s` of it."""
        while time.monotonic() < moment_s + wait_s:
            with contextlib.suppress(StaleStateError):
                return self.sample(time.monotonic() - moment_s, connected=False).state
            await asyncio.sleep(POLL_S)
        return None

    def _stale(self, age_s: float, limit_s: float) -> StaleStateError:
        """Make the error that says why the newest state is too old."""
        reader = self.reader
        if reader is None or (reader.ended is None and reader.newest is None):
            return StaleStateError("not-connected", host=self._host)
        if reader.ended is not None:
            return link_lost(reader.ended)
        if reader.not_finite:
            return StaleStateError("state-not-finite", age_s=age_s, limit_s=limit_s)
        cause, remedy = "", "Check cable and network."
        if reader.stands_still:
            cause, remedy = ": the controller's clock stands still", "Restart the controller."
        elif is_loopback(self._host):
            cause, remedy = ", which runs on this computer", "Reduce its load."
        return StaleStateError(age_s=age_s, limit_s=limit_s, cause=cause, advice=remedy)

    def at(self, host_monotonic_ns: int) -> RobotState:
        """Interpolate the state at a host time within the last 10 s; StaleStateError outside."""
        if self.reader is None:
            raise StaleStateError("not-connected", host=self._host)
        return state_at(self.history(), self.clock(), host_monotonic_ns)

    def history(self) -> Sequence[RobotState]:
        """Return the states of the last 10 s, as far as this connection gave them."""
        return self.reader.history.copy() if self.reader is not None else ()

    def clock(self) -> ClockFit | None:
        """Return the controller's clock against the host's; None before there are enough samples."""
        return self.reader.clock.fit() if self.reader is not None else None

    def evidence(self, pause_s: float, since_s: float, until_s: float) -> Evidence:
        """What was late in a span (host monotonic). `pause_s`: for how long this computer kicked nothing."""
        period_s = 1 / self.reader.rate_hz if self.reader is not None and self.reader.rate_hz else 0.0
        gap_s, clock_gap_s = largest_gap(self.history(), since_s, until_s, period_s)
        return Evidence(pause_s, gap_s, clock_gap_s, is_loopback(self._host))


def link_lost(why: str) -> StaleStateError:
    return StaleStateError("link-lost", why=why)
