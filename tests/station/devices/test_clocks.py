"""The clock estimator against clocks whose truth is known."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from station.devices.clocks import ClockEstimator, monotonic_from_wall_ns

OFFSET_NS = 5_000_000_000_000


def feed(
    clock: ClockEstimator,
    seconds: float,
    rate_hz: float,
    drift_ppm: float,
    delay_s: float,
    seed: int,
    start_s: float = 3.0,
) -> tuple[float, float]:
    """Arrivals with exponential delays over a fixed shortest one; first and last device time."""
    rng = random.Random(seed)
    count = int(seconds * rate_hz)
    for i in range(count):
        device_s = start_s + i / rate_hz
        clock.add(device_s, host_ns(device_s, drift_ppm) + round((rng.expovariate(1 / delay_s)) * 1e9))
    return start_s, start_s + (count - 1) / rate_hz


def host_ns(device_s: float, drift_ppm: float) -> int:
    return round(device_s * 1e9 * (1 + drift_ppm * 1e-6)) + OFFSET_NS


@settings(max_examples=25)
@given(
    drift_ppm=st.floats(-100, 100),
    delay_s=st.floats(1e-5, 2e-3),
    seconds=st.floats(6, 60),
    seed=st.integers(0, 10_000),
)
def test_times_are_right_within_the_bound(
    drift_ppm: float, delay_s: float, seconds: float, seed: int
) -> None:
    clock = ClockEstimator()
    first, last = feed(clock, seconds, 125, drift_ppm, delay_s, seed)
    found = clock.fit()
    for device_s in (first, (first + last) / 2, last):
        error_s = abs(found.to_host_ns(device_s) - host_ns(device_s, drift_ppm)) / 1e9
        assert error_s <= found.bound_at(device_s) + 1e-7
    assert found.bound_s < 0.0035


def test_a_few_late_arrivals_change_nothing() -> None:
    clean, disturbed = ClockEstimator(), ClockEstimator()
    for i in range(5000):
        device_s, late_ns = i * 0.002, 200_000_000 if i % 50 == 0 else 0
        clean.add(device_s, host_ns(device_s, 0))
        disturbed.add(device_s, host_ns(device_s, 0) + late_ns)
    assert disturbed.fit().to_host_ns(9.0) == pytest.approx(clean.fit().to_host_ns(9.0), abs=1000)


def test_nothing_is_claimed_too_early() -> None:
    clock = ClockEstimator()
    assert clock.fit() is None
    for i in range(4):
        clock.add(i * 0.008, i * 8_000_000)
    assert clock.fit() is None


def test_what_is_known_of_the_latency_widens_the_bound() -> None:
    clock = ClockEstimator()
    feed(clock, 10, 125, 0.0, 0.0005, seed=3)
    before_s, clock.latency_s = clock.fit().bound_s, 0.004
    assert clock.fit().bound_s == pytest.approx(before_s + 0.004)


def test_a_device_that_restarts_starts_afresh() -> None:
    clock = ClockEstimator()
    feed(clock, 10, 125, 0.0, 0.0005, seed=4, start_s=1000.0)
    for i in range(20):
        clock.add(i * 0.008, 77_000_000_000 + i * 8_000_000)
    assert clock.fit().to_host_ns(0.1) == pytest.approx(77_100_000_000, abs=2_000_000)


def test_old_arrivals_are_forgotten() -> None:
    """A network that became slower for good is noticed."""
    clock = ClockEstimator()
    _, last = feed(clock, 10, 125, 0.0, 0.0002, seed=5)
    for i in range(40 * 125):
        clock.add(last + i / 125, host_ns(last + i / 125, 0.0) + 9_000_000)
    assert clock.fit().to_host_ns(last) == host_ns(last, 0.0) + 9_000_000


@pytest.mark.parametrize("held_up_ns", [0, 5_000_000])
def test_a_thread_held_up_between_two_clocks_never_stamps_too_early(
    held_up_ns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ns = 1_000_000_000

    def read(offset_ns: int) -> int:
        nonlocal now_ns
        now_ns += held_up_ns
        return now_ns + offset_ns

    monkeypatch.setattr("station.devices.clocks.time.monotonic_ns", lambda: read(0))
    monkeypatch.setattr("station.devices.clocks.time.time_ns", lambda: read(OFFSET_NS))
    arrived_ns = now_ns - 300_000
    assert arrived_ns <= monotonic_from_wall_ns(arrived_ns + OFFSET_NS) <= arrived_ns + held_up_ns
