"""The first thing a newcomer tries: the shipped recording solves, near its own truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recordings.reader import open_recording
from tests.system.conftest import solved

SAMPLE = Path(__file__).parents[2] / "recordings" / "samples" / "paper-640.mcap"


def test_the_default_profile_finds_the_truth_within_its_claim(tmp_path: Path) -> None:
    truth = tmp_path / "truth.json"
    truth.write_bytes(open_recording(SAMPLE).attachments()["truth.json"])
    answer, off = solved(SAMPLE, tmp_path / "a.yaml", truth)
    assert np.linalg.norm(off[:3]) < 5e-4
    assert np.degrees(np.linalg.norm(off[3:])) < 0.05
    assert answer["certificate"]["certified"]
