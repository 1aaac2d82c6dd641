"""Which pause of the session's heartbeat can have tripped the watchdog."""

from __future__ import annotations

from itertools import accumulate

import pytest

from station.devices.ur import longest_gap_s


@pytest.mark.parametrize(
    ("pauses_s", "since_s", "longest_s"),
    [
        ((0.02, 0.3, 0.02), 99.0, 0.3),
        ((0.02, 0.25), 99.0, 0.25),
        ((0.44, 0.02, 0.02), 100.1, 0.02),  # one that began before is none of it
        ((), 0.0, 0.0),
    ],
)
def test_the_longest_pause_since_then_is_told(
    pauses_s: tuple[float, ...], since_s: float, longest_s: float
) -> None:
    beats_s = list(accumulate(pauses_s, initial=100.0))
    assert longest_gap_s(beats_s, since_s) == pytest.approx(longest_s)
