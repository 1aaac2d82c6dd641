"""When a picture was exposed, and how surely. By hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recordings.schema.messages import FrameTime, Image, Stamps
from station.cell.clock_fit import DRIFT
from station.cell.errors import CameraError
from station.cell.status import CameraCounts, FrameTiming
from station.devices.frames import (
    DeviceClock,
    FrameClock,
    FrameCounter,
    TriggerPulse,
    by_arrival,
    by_clock,
    by_trigger,
    frames_between,
)
from tests.codes import raises

MS = 1_000_000


def read(clock: DeviceClock, device_s: float, host_s: float, half_s: float) -> None:
    """The device showed `device_s` when the host showed `host_s`, give or take `half_s`."""
    asked_ns, answered_ns = round((host_s - half_s) * 1e9), round((host_s + half_s) * 1e9)
    clock.add(asked_ns, answered_ns, round(device_s * 1e9))


def test_trigger_and_arrival_bound_the_exposure() -> None:
    assert by_arrival(1000 * MS, 20_000.0, 970 * MS) == FrameTime(985 * MS, 0.005, "arrival")
    assert by_arrival(1000 * MS, 20_000.0, 700 * MS).bound_s == 0.14, (
        "later than any readout takes: not known"
    )


def test_a_frame_that_comes_sooner_than_its_exposure_takes_is_not_placed_surely() -> None:
    """An exposure of 1.2 s whose first packet came 0.2 s after the trigger: the answer to an earlier one."""
    assert by_arrival(1000 * MS, 1_200_000.0, 800 * MS).bound_s == 0.5
    assert by_trigger(800 * MS, 0.001, 1_200_000.0, 1000 * MS).bound_s == pytest.approx(1.001)


def test_by_the_cameras_clock_half_the_exposure_is_added_and_the_bound_grows_with_time() -> None:
    clock = DeviceClock()
    read(clock, 1.0, 501.0, 0.0001)
    told = by_clock(1_000_000_000, 20_000.0, clock.fit)
    assert told.host_monotonic_ns == pytest.approx(501_010 * MS, abs=10)
    assert told.bound_s == pytest.approx(0.0001)
    told = by_clock(11_000_000_000, 20_000.0, clock.fit)
    assert told.host_monotonic_ns == pytest.approx(511_010 * MS, abs=10)
    assert told.bound_s == pytest.approx(0.0001 + 10 * DRIFT)


def frame(device_ms: int, arrival_ms: int) -> Image:
    stamps = Stamps(host_monotonic_ns=arrival_ms * MS, device_ns=device_ms * MS)
    return Image(np.zeros((1, 1), np.uint8), stamps, 1, 0, exposure_us=20_000.0)


def test_a_frame_is_placed_by_the_best_source_that_it_bears_out() -> None:
    """The camera's clock is 500 s behind the host's."""
    clock = FrameClock()
    assert clock.timing is None
    clock.restart()
    assert clock.timing == FrameTiming("arrival", 0.025), "open, and its clock cannot be read"
    read(clock.readings, 0.9, 500.9, 0.0001)
    assert clock.timing.source == "latched"
    good = clock.timed(frame(1000, 501_040), 500_999 * MS)
    assert good.time == FrameTime(501_010 * MS, pytest.approx(0.00011), "latched")
    for device_ms in (998, 1025):  # before its trigger; still exposing when its first packet came
        wrong = clock.timed(frame(device_ms, 501_040), 500_999 * MS)
        assert wrong.time == by_arrival(501_040 * MS, 20_000.0, 500_999 * MS)
    assert clock.timing is not None and clock.timing.impossible == 2
    no_stamp = clock.timed(frame(0, 501_040), 500_999 * MS)
    assert no_stamp.time is not None and no_stamp.time.source == "arrival"


def test_without_a_clock_the_pulse_of_the_trigger_box_tells() -> None:
    """The box fired at 501.000 s ± 1 ms, the camera exposes 20 ms and reads out for 15 ms."""
    pulse = TriggerPulse(1, 501_000 * MS, 0.001)
    rough = FrameClock().timed(frame(0, 501_035), 500_999 * MS, pulse)
    assert rough.time == FrameTime(501_010 * MS, pytest.approx(0.016), "trigger"), "it may wait 15 ms"


@pytest.mark.parametrize("drift_ppm", [-80.0, 0.0, 40.0])
def test_read_once_a_second_over_uneven_delays_the_time_is_right_within_its_bound(drift_ppm: float) -> None:
    rng, clock, inside = np.random.default_rng(7), DeviceClock(), 0
    for second in range(300):
        asked_ns = second * 10**9
        there_ns, back_ns = (int(200_000 + rng.exponential(150_000)) for _ in range(2))
        device_ns = round((asked_ns + there_ns) * (1 + 1e-6 * drift_ppm)) + 10**15
        clock.add(asked_ns, asked_ns + there_ns + back_ns, device_ns)
        host_ns = asked_ns + int(rng.uniform(0, 10**9))
        told = by_clock(round(host_ns * (1 + 1e-6 * drift_ppm)) + 10**15, 0.0, clock.fit)
        inside += abs(told.host_monotonic_ns - host_ns) / 1e9 <= told.bound_s
        assert told.bound_s < 0.001
    assert inside >= 285


def test_a_clock_that_was_set_begins_anew() -> None:
    clock = DeviceClock()
    read(clock, 1.0, 501.0, 0.0001)
    for device_s in (900.0, 2.0):  # forwards, however slowly it is read; back
        read(clock, device_s, 502.0, 0.01)
        assert clock.fit is not None and clock.fit.to_host_ns(device_s) == 502_000 * MS


def test_the_newest_good_reading_counts_not_the_newest() -> None:
    clock = DeviceClock()
    read(clock, 1.0, 501.0, 0.0001)
    read(clock, 1.1, 501.1 + 0.003, 0.004)
    fit = clock.fit
    assert fit is not None and fit.bound_s == pytest.approx(0.0001)
    assert fit.to_host_ns(1.1) == pytest.approx(501_100 * MS, abs=10)


@pytest.mark.parametrize(("first", "bits"), [(1, 16), (0, 8), (0, 16), (0, 64)])
@given(count=st.integers(0, 1 << 66))
def test_after_the_largest_id_the_next_one_is_the_next_frame(first: int, bits: int, count: int) -> None:
    size = (1 << bits) - first
    before, after = (first + n % size for n in (count, count + 1))
    assert frames_between(before, after) == 1 or before == 0 == after


def test_lost_frames_are_counted_a_number_from_before_begins_anew_and_missing_ids_cost_nothing() -> None:
    assert frames_between(65_520, 65_523) == 3 and frames_between(7, 7) == 0
    extended = FrameCounter()
    for number in (65_534, 65_535, 65_536, 65_537):
        extended.accept(number)
    for silent in (None, 0):
        counter = FrameCounter()
        for _ in range(3):
            counter.accept(silent)
        assert counter.counts() == CameraCounts(frames=3)
    with raises("frame-ids-restarted"):
        extended.accept(3)


def test_after_a_loss_any_number_may_be_the_next_and_the_pulses_go_on_from_there() -> None:
    counter = FrameCounter()
    counter.accept(1, pulse_count=10)
    counter.lost(pulse_count=11)
    counter.accept(7, pulse_count=12)
    assert counter.counts() == CameraCounts(frames=2, missing=1, paired=2)
    counter.accept(8, pulse_count=1)  # the box was lost and opened again
    with raises("pulse-count"):
        counter.accept(9, pulse_count=3)


def test_18_a_gap_in_the_frame_ids_is_an_error_even_where_a_picture_came() -> None:
    counter = FrameCounter()
    counter.accept(65_531)
    with raises("frames-lost"):
        counter.accept(65_534)
    assert counter.missing == 2
    counter.accept(65_535)
    with raises("frame-twice"):
        counter.accept(65_535)
    counter.accept(1)
    assert counter.counts().frames == 3


@given(st.integers(1, 65_535), st.lists(st.sampled_from(["good", "lost", "extra pulse"]), max_size=40))
def test_whatever_happens_only_undisturbed_pictures_are_accepted(first_id: int, events: list[str]) -> None:
    """A camera and a box that miscount at random: no accepted picture follows an unnoticed disturbance."""
    counter, frame_id, pulse = FrameCounter(), first_id, 50
    counter.accept(frame_id, pulse)
    accepted = 1
    for event in events:
        frame_id, pulse = frame_id % 65_535 + 1, pulse + 1
        if event == "lost":  # this trigger's frame never comes; the driver says so and goes on
            counter.lost(pulse)
            continue
        if event == "extra pulse":
            pulse += 1
            with pytest.raises(CameraError):
                counter.accept(frame_id, pulse)
            continue
        counter.accept(frame_id, pulse)
        accepted += 1
        assert counter.counts().frames == accepted
