"""Faults 24 and 25: steps of the host's clock and wrong stamps of the camera's do not reach the pairing."""

from __future__ import annotations

import time

import pytest

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
