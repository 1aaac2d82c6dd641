"""`station demo`: it finds the truth; what is said when one of its steps fails."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from station.cli.demo import DemoError, _solve


@pytest.mark.process
@pytest.mark.timeout(900)
def test_the_demo_finds_the_truth(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "station.cli", "demo", "--headless", "--json", "--seed", "4"]
    command += ["--out", str(tmp_path), "--poses", "12", "--time-scale", "2"]
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert done.returncode in (0, 4), done.stderr  # 12 poses may be too few for a gate
    result = json.loads(done.stdout)
    assert result["poses"] == {"planned": 12, "captured": 12}
    assert result["truth_error"]["translation_mm"] <= 0.5
    assert result["truth_error"]["rotation_deg"] <= 0.05
    for name in ("recording", "calibration", "report"):
        assert Path(result[name]).is_file()


async def test_a_solve_that_failed_says_why_under_one_name(tmp_path: Path) -> None:
    with pytest.raises(DemoError) as failed:
        await _solve(tmp_path / "none.mcap", tmp_path / "calibration.yaml", tmp_path / "report.html")
    assert str(tmp_path / "none.mcap") in str(failed.value)
