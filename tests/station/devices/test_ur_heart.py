"""Which pause of the session's heartbeat can have tripped the watchdog."""

from __future__ import annotations

import pytest

from station.devices.ur import HeartbeatMonitor


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


def beating(clock: Clock, *pauses_s: float) -> HeartbeatMonitor:
    heart = HeartbeatMonitor(clock)
    heart.beat()
    for pause_s in pauses_s:
        clock.now_s += pause_s
        heart.beat()
    return heart


def test_the_longest_pause_since_then_is_told(clock: Clock) -> None:
    heart = beating(clock, 0.02, 0.3, 0.02)
    assert heart.worst_s(since_s=99.0) == pytest.approx(0.3)


def test_a_pause_that_goes_on_counts(clock: Clock) -> None:
    heart = beating(clock, 0.02)
    clock.now_s += 0.25
    assert heart.worst_s(since_s=99.0) == pytest.approx(0.25)


def test_a_pause_that_began_before_is_none_of_it(clock: Clock) -> None:
    heart = beating(clock, 0.44, 0.02, 0.02)
    assert heart.worst_s(since_s=100.1) == pytest.approx(0.02)


def test_a_heart_that_never_beat_has_no_pause(clock: Clock) -> None:
    assert HeartbeatMonitor(clock).worst_s(since_s=0.0) == 0.0
