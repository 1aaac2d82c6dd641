"""The RTDE port of a running controller: versions and rates."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from itertools import pairwise

import pytest

from station.devices.rtde import PacketType
from station.simulation.launch import SimulatedController, start_controller

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def arm() -> Iterator[Callable[[str], SimulatedController]]:
    """One controller a model for all tests of this module: nothing here moves an arm or starts a program."""
    with ExitStack() as ends:
        yield cache(lambda model: ends.enter_context(start_controller(model)))


@pytest.mark.parametrize(
    ("model", "asked_hz", "step_s", "version"),
    [
        ("UR10", 125.0, 0.008, (3, 15, 8, 106339)),
        ("UR10e", 125.0, 0.008, (5, 11, 1, 108318)),
    ],
)
def test_versions_and_samples_at_the_rate_that_was_asked_for(
    arm, rtde, model, asked_hz, step_s, version
) -> None:
    client = rtde(arm(model))
    assert client.request(PacketType.PROTOCOL_VERSION, b"\x00\x01") == b"\x00"
    assert struct.unpack(">4I", client.request(PacketType.CONTROLLER_VERSION)) == version
    client.start("timestamp", "actual_q", frequency_hz=asked_hz)
    stamps = [client.sample()["timestamp"] for _ in range(8)]
    assert [b - a for a, b in pairwise(stamps)] == pytest.approx([step_s] * 7, abs=1e-9)
