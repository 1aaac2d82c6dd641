"""The whole daemon records a free-running GigE camera while the arm moves, each picture to the bit."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.daemon_stream import HEADER, measure, row
from station.cell.config import CameraConfig
from station.cell.errors import StationError
from station.devices.aravis_device import GenicamDevice
from tests.isolated_network import isolated_thread

pytestmark = pytest.mark.process
AUTOGROUP = Path("/proc/self/autogroup")


@pytest.fixture(autouse=True)
def permitted() -> None:
    """Skipped, with the reason, where there is no Aravis or no right to a network of its own."""
    try:
        GenicamDevice(CameraConfig())
        with isolated_thread():
            pass
    except StationError as error:
        pytest.skip(str(error))


@pytest.mark.gige
def test_the_daemon_keeps_every_frame_of_a_few_seconds() -> None:
    group = AUTOGROUP.read_text() if AUTOGROUP.exists() else ""
    outcome = measure(30.0, 3.0)
    if group:  # what was measured went before others, and never the session of the tests
        assert AUTOGROUP.read_text() == group
    assert outcome.checked.frames > 50 and outcome.checked.states > 1000
    assert outcome.clean, outcome


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("fps", "seconds"), [(75.0, 600.0), (150.0, 120.0)])
def test_minutes_of_full_rate_lose_nothing(fps: float, seconds: float) -> None:
    outcome = measure(fps, seconds)
    print(f"\n| {HEADER.replace('|', ' | ')} |\n{row(outcome)}")
    assert outcome.checked.frames > 0.9 * fps * seconds
    assert outcome.clean, outcome
    assert outcome.memory_mib < 700
