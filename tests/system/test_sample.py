"""The first thing a newcomer tries: the shipped recording solves, near its own truth, the same twice."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibrate.geometry import difference
from recordings.reader import open_recording
from station.simulation.truth import CellTruth, read_truth

SAMPLE = Path(__file__).parents[2] / "recordings" / "samples" / "paper-640.mcap"


def solve(profile: str, output: Path) -> dict[str, Any]:
    """In a process of its own."""
    options = ("--profile", profile, "--json")
    done = subprocess.run(
        [sys.executable, "-m", "calibrate.cli", "solve", str(SAMPLE), *options, "-o", str(output)],
        capture_output=True,
        text=True,
    )
    assert done.returncode in (0, 4), done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


@pytest.fixture(scope="module")
def robust(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return solve("robust", tmp_path_factory.mktemp("robust") / "a.yaml")


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> CellTruth:
    path = tmp_path_factory.mktemp("truth") / "truth.json"
    path.write_bytes(open_recording(SAMPLE).attachments()["truth.json"])
    return read_truth(path)


def test_the_default_profile_finds_the_truth_within_its_claim(
    truth: CellTruth, robust: dict[str, Any]
) -> None:
    answer = robust
    error = difference(np.array(answer["result"]["matrix"]), np.array(truth.camera_mount))
    assert np.linalg.norm(error[:3]) < 5e-4
    assert np.degrees(np.linalg.norm(error[3:])) < 0.05
    # 22.5: the 99.9 % quantile of chi-square with 6 degrees of freedom.
    assert error @ np.linalg.solve(np.array(answer["covariance"]), error) < 22.5
    assert answer["certificate"]["certified"]


def test_two_processes_give_the_same_bits(tmp_path: Path) -> None:
    """Of the robust profile: tests/calibrate/cli."""
    first, second = (solve("paper", tmp_path / name) for name in ("a.yaml", "b.yaml"))
    assert first["result"] == second["result"]
    assert first["holdout"] == second["holdout"]
    assert first["covariance"] == second["covariance"]
