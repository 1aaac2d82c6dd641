"""When a state came: by the kernel's word, which is given in wall time, whatever is done to that clock."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest

from station.devices.ur.stream import _TIMESPEC, SO_TIMESTAMPNS, StateReader

S = 1_000_000_000
MS = 1_000_000


class Clocks:
    """Both of the host's; nothing passes by itself."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns, self.ahead_ns = 1000 * S, 10**18
        monkeypatch.setattr(time, "monotonic_ns", lambda: self.now_ns)
        monkeypatch.setattr(time, "time_ns", lambda: self.now_ns + self.ahead_ns)

    def stamp(self) -> list[tuple[int, int, bytes]]:
        """Give the stamp of the kernel on bytes that come now."""
        value = _TIMESPEC.pack(*divmod(self.now_ns + self.ahead_ns, S))
        return [(socket.SOL_SOCKET, SO_TIMESTAMPNS, value)]


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    return Clocks(monkeypatch)


@pytest.fixture
def reader(clocks: Clocks) -> Iterator[StateReader]:
    made = StateReader("127.0.0.1", lambda state: None, lambda why: None)
    yield made
    made._link.close()


def test_bytes_that_waited_came_when_the_kernel_says(reader: StateReader, clocks: Clocks) -> None:
    came_ns, stamp = clocks.now_ns, clocks.stamp()
    clocks.now_ns += 3 * MS
    assert reader._arrival(stamp)[0] == came_ns


@pytest.mark.parametrize("step_s", [0.2, 3.0, 3600.0, -0.2, -3.0])
def test_24_a_clock_that_is_set_while_bytes_wait_makes_them_neither_older_nor_newer(
    reader: StateReader, clocks: Clocks, step_s: float
) -> None:
    """Too early by the step they would spoil the robot's clock for five minutes: no pose's time was known."""
    came_ns, first, second = clocks.now_ns, clocks.stamp(), clocks.stamp()
    clocks.ahead_ns += round(step_s * S)
    clocks.now_ns += MS
    for stamp in (first, second):
        arrived_ns, _ = reader._arrival(stamp)
        assert came_ns <= arrived_ns <= clocks.now_ns
    clocks.now_ns += 2 * MS
    came_ns, stamp = clocks.now_ns, clocks.stamp()
    clocks.now_ns += MS
    assert reader._arrival(stamp)[0] == came_ns, "the new time is as good as the old one"


def test_after_a_long_halt_of_this_process_what_waited_is_as_old_as_it_is(
    reader: StateReader, clocks: Clocks
) -> None:
    came_ns, stamp = clocks.now_ns, clocks.stamp()
    clocks.now_ns += 15 * S
    assert reader._arrival(stamp)[0] == came_ns


def test_one_slow_answer_at_the_start_bounds_no_time(
    reader: StateReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A busy computer's first round trip took 43 ms: no image of the session was placed well enough."""
    now_s, trips_s = 0.0, iter([0.043, 0.008, 0.0006, 0.05])

    class Link:
        def version(self) -> tuple[int, int, int, int]:
            nonlocal now_s
            now_s += next(trips_s)
            return 5, 11, 0, 0

        def outputs(self, rate_hz: float, names: object) -> None: ...

        def start(self) -> None: ...

    monkeypatch.setattr(time, "perf_counter", lambda: now_s)
    reader._handshake(Link())
    assert reader.clock.latency_s == pytest.approx(0.0003) and next(trips_s) == 0.05
