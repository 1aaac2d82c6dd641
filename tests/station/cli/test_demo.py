"""`station demo`: it finds the truth; what is said when one of its steps fails."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate.files.calibration import read_calibration
from station.cell.status import PoseStatus, SessionStatus, StationState, StationStatus
from station.cli.demo import DemoJson, _solved
from tests.codes import raises
from tests.recordings.small_recording import shown


@pytest.mark.process
@pytest.mark.timeout(900)
def test_the_demo_finds_the_truth(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "station.cli", "demo", "--headless", "--json", "--seed", "4"]
    command += ["--out", str(tmp_path), "--poses", "9", "--time-scale", "4"]
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert done.returncode in (0, 4), done.stderr  # 9 poses may be too few for a gate
    result = json.loads(done.stdout)
    assert msgspec.json.encode(msgspec.convert(result, DemoJson, strict=True)).decode() == done.stdout.strip()
    assert result["poses"] == {"planned": 9, "captured": 9}
    assert result["truth_error"]["translation_mm"] <= 0.5
    assert result["truth_error"]["rotation_deg"] <= 0.05
    for name in ("recording", "calibration", "report"):
        assert Path(result[name]).is_file()
    # The recording's own growing estimate, which viewers show as frames.
    recording = Path(result["recording"])
    last = max(recording.glob("*.mcap")) if recording.is_dir() else recording
    at = shown(last, "/tf_static")[-1][1].translation
    solved = read_calibration(Path(result["calibration"]))
    assert np.allclose((at.x, at.y, at.z), solved.transform.matrix[:3, 3], atol=5e-3)
    assert shown(last, "/tf_static/board")


def test_a_solve_that_failed_says_why(tmp_path: Path) -> None:
    session = SessionStatus(folder=str(tmp_path), recording=str(tmp_path / "none.mcap"))
    with raises("demo-solve-failed") as failed:
        _solved(StationStatus(session=session))
    assert str(tmp_path / "none.mcap") in str(failed.value)


def test_a_demo_that_stops_on_the_way_says_where_its_poses_are() -> None:
    session = SessionStatus(name="s-1", folder="/data/s-1", captured=9, poses=(PoseStatus(0, "p01"),) * 25)
    with raises("demo-unfinished", captured=9, poses=25) as failed:
        _solved(StationStatus(StationState.FAULT, "no news from the robot", session=session))
    assert "/data/s-1" in str(failed.value) and failed.value.remedy
