"""Faults 24 and 25: steps of the host's clock and drift of the camera's do not reach the pairing."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from recordings.schema.messages import ClockReading
from station.devices.frame_time import DeviceClock, by_clock
from station.simulation.camera import RenderedCamera
from tests.faults.conftest import LOOP


@LOOP
@pytest.mark.process
async def test_24_an_ntp_step_of_an_hour_moves_no_mid_exposure(
    camera: RenderedCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = await camera.capture()
    true_time_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: true_time_ns() + 3600 * 10**9)
    asked_ns = time.monotonic_ns()
    after = await camera.capture()
    stamps, told = after.stamps, after.time
    assert told is not None and told.source == "latched"
    assert asked_ns - told.bound_s * 1e9 < told.host_monotonic_ns < time.monotonic_ns()
    stepped_s = (stamps.host_wall_ns - before.stamps.host_wall_ns) / 1e9
    assert 3600 < stepped_s < 3630, "the wall clock is recorded as it was"


@LOOP
@pytest.mark.process
async def test_25_a_stamp_that_cannot_be_is_replaced_by_the_arrival_and_counted(
    camera: RenderedCamera,
) -> None:
    await camera.inject("stamp-error", -(10**10))
    wrong = await camera.capture()
    assert wrong.time is not None and wrong.time.source == "arrival"
    assert camera.timing is not None and camera.timing.impossible == 1
    await camera.inject("stamp-error", 0)
    right = await camera.capture()
    assert right.time is not None and right.time.source == "latched"


def simulated_readings(
    rng: np.random.Generator, drift_ppm: float, seconds: int
) -> tuple[DeviceClock, Callable[[int], int]]:
    """A clock read once a second over a line with uneven delays, and the truth: host → device time."""
    start_ns, offset_ns = 10**12, int(rng.integers(-(10**15), 10**15))

    def device_at(host_ns: int) -> int:
        return round(host_ns + (host_ns - start_ns) * drift_ppm * 1e-6) + offset_ns

    clock = DeviceClock()
    for second in range(seconds):
        asked_ns = start_ns + second * 10**9
        there_ns, back_ns = (int(200_000 + rng.exponential(150_000)) for _ in range(2))
        clock.add(ClockReading(asked_ns, asked_ns + there_ns + back_ns, device_at(asked_ns + there_ns)))
    return clock, device_at


@pytest.mark.parametrize("drift_ppm", [-80.0, 0.0, 40.0])
def test_25_offset_and_drift_are_within_their_bound(drift_ppm: float) -> None:
    rng = np.random.default_rng(7)
    inside = 0
    for _ in range(100):
        clock, device_at = simulated_readings(rng, drift_ppm, seconds=60)
        fit = clock.fit
        assert fit is not None and abs(-fit.drift_ppm - drift_ppm) < 25
        host_ns = 10**12 + int(rng.uniform(20, 60) * 1e9)
        told = by_clock(device_at(host_ns), 0.0, fit, "latched")
        inside += abs(told.host_monotonic_ns - host_ns) / 1e9 <= told.bound_s
        assert told.bound_s < 0.003
    assert inside >= 93
