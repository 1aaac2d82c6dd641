"""`station capture --sweep` in a simulated cell, at real speed: the frame times agree with the robot."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from calibrate.quality.sweep import sweep_time_offset
from recordings.reader import open_recording
from station.simulation.cell import read_truth

STATION = (sys.executable, "-m", "station.cli")


@pytest.mark.soak
@pytest.mark.process
@pytest.mark.parametrize("seed", range(5))
def test_the_offset_is_within_its_bound(tmp_path: Path, seed: int) -> None:
    socket = tmp_path / "control.sock"
    serve = [*STATION, "serve", "--simulate", "--seed", str(seed), "--socket", str(socket)]
    with subprocess.Popen([*serve, "--root", str(tmp_path)]) as daemon:
        try:
            while not socket.exists():
                assert daemon.poll() is None
                time.sleep(0.1)
            sweep = [*STATION, "capture", "--sweep", "--headless", "--socket", str(socket)]
            assert subprocess.run(sweep, timeout=90).returncode == 0
        finally:
            daemon.terminate()
    (recording,) = (open_recording(path) for path in tmp_path.glob("sessions/*/*.mcap"))
    truth = read_truth(tmp_path / "simulation" / "truth.json")
    found = sweep_time_offset(recording, truth.camera)
    print(f"\nseed {seed}: {1e3 * found.offset_s:+.3f} ms, sigma {1e3 * found.sigma_s:.3f} ms")
    assert found.source == "latched" and found.agrees
