"""The first thing a newcomer tries: the shipped recording solves, near its own truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from calibrate.cli import main
from calibrate.geometry import difference
from recordings.reader import open_recording
from station.simulation.truth import read_truth
from tests.command_line import call

SAMPLE = Path(__file__).parents[2] / "recordings" / "samples" / "paper-640.mcap"


def test_the_default_profile_finds_the_truth_within_its_claim(tmp_path: Path) -> None:
    done = call(main, "solve", SAMPLE, "--json", "-o", tmp_path / "a.yaml")
    assert done.returncode in (0, 4), done.stderr
    answer = json.loads(done.stdout)
    (tmp_path / "truth.json").write_bytes(open_recording(SAMPLE).attachments()["truth.json"])
    true = read_truth(tmp_path / "truth.json").camera_mount
    error = difference(np.array(answer["result"]["matrix"]), np.array(true))
    assert np.linalg.norm(error[:3]) < 5e-4
    assert np.degrees(np.linalg.norm(error[3:])) < 0.05
    # 22.5: the 99.9 % quantile of chi-square with 6 degrees of freedom.
    assert error @ np.linalg.solve(np.array(answer["covariance"]), error) < 22.5
    assert answer["certificate"]["certified"]
