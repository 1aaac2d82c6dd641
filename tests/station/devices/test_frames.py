"""When a picture was exposed, and how surely; what is lost of free-running pictures. By hand."""

from __future__ import annotations

import pytest

from recordings.schema.clocks import UNFITTED_DRIFT
from station.devices.frames import LAST_FRAME_ID, DeviceClock, FrameCounter, mid_exposure

MS = 1_000_000


def read(clock: DeviceClock, device_s: float, host_s: float, half_s: float) -> None:
    """The device showed `device_s` when the host showed `host_s`, give or take `half_s`."""
    clock.reading(round(device_s * 1e9), round((host_s - half_s) * 1e9), round((host_s + half_s) * 1e9))


def test_without_a_clock_the_exposure_ended_within_fifty_ms_before_the_arrival() -> None:
    assert mid_exposure(0, 1000 * MS, 20_000.0, None) == ((1000 - 25 - 10) * MS, 0.025)


def test_a_clock_is_of_no_use_to_a_picture_without_a_stamp() -> None:
    clock = DeviceClock()
    read(clock, 1.0, 501.0, 0.0001)
    assert mid_exposure(0, 1000 * MS, 20_000.0, clock.fit) == mid_exposure(0, 1000 * MS, 20_000.0, None)


def test_by_the_cameras_clock_half_the_exposure_is_added_and_the_bound_grows_with_time() -> None:
    clock = DeviceClock()
    read(clock, 1.0, 501.0, 0.0001)
    at_ns, bound_s = mid_exposure(1_000_000_000, 0, 20_000.0, clock.fit)
    assert at_ns == pytest.approx(501_010 * MS, abs=10)
    assert bound_s == pytest.approx(0.0001)
    at_ns, bound_s = mid_exposure(11_000_000_000, 0, 20_000.0, clock.fit)
    assert at_ns == pytest.approx(511_010 * MS, abs=10)
    assert bound_s == pytest.approx(0.0001 + 10 * UNFITTED_DRIFT)


def test_readings_too_slow_to_tell_a_drift_tell_none() -> None:
    quick, slow = DeviceClock(), DeviceClock()
    for clock, half_s in ((quick, 0.0001), (slow, 0.005)):
        for k in range(11):
            read(clock, float(k), 500.0 + k * (1 + 40e-6), half_s)
    assert quick.fit is not None and quick.fit.drift == pytest.approx(40e-6, abs=1e-9)
    assert quick.fit.drift_uncertainty < UNFITTED_DRIFT
    assert slow.fit is not None and slow.fit.drift == 0.0
    assert slow.fit.drift_uncertainty == UNFITTED_DRIFT


def test_the_newest_good_reading_counts_not_the_newest() -> None:
    clock = DeviceClock()
    read(clock, 1.0, 501.0, 0.0001)
    read(clock, 1.1, 501.1 + 0.003, 0.004)
    fit = clock.fit
    assert fit is not None and fit.latency_s == pytest.approx(0.0001)
    assert fit.to_host_ns(1.1) == pytest.approx(501_100 * MS, abs=10)


def test_gaps_of_a_free_running_camera_are_counted_across_the_end_of_its_numbers() -> None:
    counter = FrameCounter()
    numbers = [counter.follow(frame_id) for frame_id in (LAST_FRAME_ID - 4, LAST_FRAME_ID - 1, 1, 2)]
    assert numbers == [0, 1, 2, 3]
    assert counter.missing == 2 + 1
    assert counter.counts().frames == 4


def test_after_a_loss_any_number_may_be_the_next_and_the_pulses_go_on_from_there() -> None:
    counter = FrameCounter()
    counter.accept(1, pulse_count=10)
    counter.lost(pulse_count=11)
    assert counter.accept(7, pulse_count=12) == 1
    assert counter.counts().paired == 2 and counter.missing == 1
